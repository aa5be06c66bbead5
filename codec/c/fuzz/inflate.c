/* SPDX-License-Identifier: Apache-2.0 */
/* Fuzz csplat_inflate by libFuzzer, `make fuzz-c`. An input is one of two things:
 *
 * - a stream: csplat_inflate and zlib accept the same streams and return the same bytes;
 * - the lengths of a code: make_table accepts what COD-6 allows, and whatever bits follow, decoding reads an entry that was
 *   written, and the right one. */
#include "../inflate.c"

#include <stdlib.h>
#include <zlib.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/* Code of the checks does not count as coverage of the decoder. */
#define UNCOVERED __attribute__((no_sanitize("coverage")))

/* A kind of code: the most symbols and bits, other arguments of make_table, the size of its table, and what COD-6
 * allows besides complete codes. */
typedef struct kind {
    unsigned symbols_max, bits_max, root, least, entries;
    uint32_t (*means)(unsigned);
    int may_be_empty, may_be_one_bit;
} kind;

static const kind KINDS[] = {
    {LENGTHS, 7, LENGTH_ROOT, 2, LENGTH_ENTRIES, length_entry, 0, 0},
    {LITERALS, BITS_MAX, LITERAL_ROOT, 1, LITERAL_ENTRIES, literal_entry, 0, 1},
    {DISTANCES, BITS_MAX, DISTANCE_ROOT, 0, DISTANCE_ENTRIES, distance_entry, 1, 1},
};

/* Make lengths from two bytes per step: a step replaces a codeword by two that are one bit longer, so that a complete code stays
 * complete, or sets a length to any value. */
UNCOVERED static void make_lengths(const kind *k, const uint8_t *data, size_t size, uint8_t *lengths, unsigned symbols)
{
    memset(lengths, 0, symbols);
    lengths[0] = 1;
    lengths[symbols - 1] = 1;
    for (size_t i = 0; i + 1 < size && i < 4 * LITERALS; i += 2) {
        unsigned symbol = (data[i + 1] | (data[i] & 0x10u) << 4) % symbols, other = symbol;
        if (data[i] & 0x80) {
            lengths[symbol] = data[i] & k->bits_max;
            continue;
        }
        for (unsigned tries = symbols; tries && (!lengths[symbol] || lengths[symbol] == k->bits_max); tries--)
            symbol = (symbol + 1) % symbols;
        for (unsigned tries = symbols; tries && lengths[other]; tries--)
            other = (other + 1) % symbols;
        if (lengths[symbol] && lengths[symbol] < k->bits_max && !lengths[other])
            lengths[other] = ++lengths[symbol];
    }
}

UNCOVERED static int is_allowed(const kind *k, const uint8_t *lengths, unsigned symbols)
{
    uint32_t sum = 0, used = 0;
    for (unsigned i = 0; i < symbols; i++)
        if (lengths[i]) {
            sum += UINT32_C(1) << (BITS_MAX - lengths[i]);
            used++;
        }
    if (used == 0)
        return k->may_be_empty;
    return sum == UINT32_C(1) << BITS_MAX || (used == 1 && 2 * sum == UINT32_C(1) << BITS_MAX && k->may_be_one_bit);
}

/* Assign codewords by RFC 1951, 3.2.2, and return the entry expected for each sequence of BITS_MAX bits. */
__attribute__((no_sanitize("address", "coverage"))) static const uint32_t *expected_entries(const kind *k, const uint8_t *lengths,
                                                                                            unsigned symbols)
{
    static uint32_t expected[1 << BITS_MAX];
    uint32_t codeword = 0;
    for (unsigned i = 0; i < 1u << BITS_MAX; i++)
        expected[i] = WRONG;
    for (unsigned bits = 1; bits <= k->bits_max; bits++, codeword <<= 1)
        for (unsigned symbol = 0; symbol < symbols; symbol++)
            if (lengths[symbol] == bits) {
                const uint32_t meaning = k->means(symbol) | bits;
                uint32_t reversed = 0;
                for (unsigned i = 0; i < bits; i++)
                    reversed |= (codeword >> i & 1) << (bits - 1 - i);
                for (; reversed < 1u << BITS_MAX; reversed += 1u << bits)
                    expected[reversed] = meaning;
                codeword++;
            }
    return expected;
}

/* Check every entry that decoding may read, and that it depends on no bit beyond those that index it. */
UNCOVERED static void check_entries(const kind *k, const uint32_t *table, const uint32_t *expected)
{
    for (unsigned i = 0; i < 1u << k->root; i++) {
        const unsigned sub = table[i] & SUBTABLE ? table[i] >> 8 & 15 : 0;
        if (k->root + sub > BITS_MAX)
            abort();
        for (unsigned j = 0; j < 1u << sub; j++) {
            const reader r = {NULL, NULL, i | j << k->root, BITS_MAX};
            const uint32_t e = entry(table, &r, k->root);
            if (e != expected[r.bits] || (e & 31) > k->root + sub)
                abort();
        }
    }
}

/* Check that a pair is two literals that its index contains, and that all other entries stay as they are. */
UNCOVERED static void check_pairs(uint32_t *table)
{
    uint32_t before[LITERAL_ENTRIES];
    memcpy(before, table, sizeof before);
    pair_literals(table);
    for (unsigned i = 0; i < LITERAL_ENTRIES; i++) {
        const uint32_t first = before[i];
        uint32_t second, bits;
        if (table[i] == first)
            continue;
        second = i < 1u << LITERAL_ROOT ? before[i >> (first & 31)] : 0;
        bits = (first & 31) + (second & 31);
        if (!(first & second & LITERAL) || bits > LITERAL_ROOT || (table[i] & 31) != bits || table[i] >> 24 != second >> 16 ||
            (table[i] >> 16 & 255) != first >> 16 || (table[i] & 0xFFE0) != (LITERAL | PAIR))
            abort();
    }
}

/* The first byte chooses the kind of code, the second the number of its symbols. */
UNCOVERED static void check_code(const uint8_t *data, size_t size)
{
    const kind *k = &KINDS[data[0] % 3];
    const unsigned symbols = k->symbols_max - data[1] % (k->symbols_max - 1);
    uint8_t *lengths = malloc(symbols); /* exactly as large as allowed, for the sanitizer */
    uint32_t *table = malloc(k->entries * sizeof *table);
    make_lengths(k, data + 2, size - 2, lengths, symbols);
    memset(table, 0xFF, k->entries * sizeof *table); /* no entry has all bits */
    if (make_table(lengths, symbols, k->means, k->root, k->least, table) != is_allowed(k, lengths, symbols))
        abort();
    if (is_allowed(k, lengths, symbols)) {
        check_entries(k, table, expected_entries(k, lengths, symbols));
        if (k->means == literal_entry)
            check_pairs(table);
    }
    free(table);
    free(lengths);
}

/* The first byte is the difference between the requested size and zlib's output: 0 in most cases. */
static void check_stream(const uint8_t *data, size_t size)
{
    enum { ROOM = 1 << 16 };
    static uint8_t theirs[ROOM];
    z_stream z = {0};
    uint8_t *coded, *ours;
    size_t wanted;
    int ended, right;
    if (inflateInit2(&z, -MAX_WBITS) != Z_OK)
        return;
    coded = malloc(size - 1); /* exactly this size, so that the sanitizer detects reads beyond it */
    memcpy(coded, data + 1, size - 1);
    z.next_in = coded;
    z.avail_in = (uInt)size - 1;
    z.next_out = theirs;
    z.avail_out = ROOM;
    ended = inflate(&z, Z_FINISH) == Z_STREAM_END && z.avail_in == 0;
    wanted = z.total_out + (data[0] == 1) - (data[0] == 2 && z.total_out);
    inflateEnd(&z);
    ours = malloc(wanted ? wanted : 1);
    right = csplat_inflate(NULL, coded, size - 1, ours, wanted);
    if (right != (ended && wanted == z.total_out) || (right && memcmp(ours, theirs, wanted) != 0))
        abort();
    free(ours);
    free(coded);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (size < 2)
        return 0;
    if (data[0] < 0x80)
        check_stream(data, size);
    else
        check_code(data, size);
    return 0;
}
