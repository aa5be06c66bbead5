/* SPDX-License-Identifier: Apache-2.0 */
/* A deflate for the encoder: raw DEFLATE (RFC 1951) that obeys the specification, 6.2. It allocates no memory.
 *
 * Planes of quantised values rarely repeat, so there are three ways to find matches: in hash chains, runs of one byte only, and
 * none. The best on four samples compresses all bytes. A block ends where the statistics of its symbols change. */
#include "csplat_encode.h"

#include <string.h>

enum { LITERALS = 286, FIXED_LITERALS = 288, DISTANCES = 30, LENGTHS = 19, END = 256, BITS_MAX = 15, LENGTH_BITS_MAX = 7 };
enum { MATCH_MIN = 4, MATCH_MAX = 258, WINDOW = 1 << 15, HASH_BITS = 14, CHAIN_MAX = 6 };
enum { CHUNK = 8192, BLOCK = 1 << 16 }; /* symbols after which a block may end, and has to end */
enum { HEADER_BITS = 480 };             /* typical size of the codes of a block */
enum { FIXED_SYMBOLS_MAX = 1024 };      /* symbols of a block from which codes of its own are shorter */
enum { SAMPLE = 4096, SAMPLES = 4 };

typedef enum method { CHAINS, RUNS, NO_MATCHES, METHODS } method;

typedef struct frequencies {
    uint32_t literals[LITERALS], distances[DISTANCES];
} frequencies;

typedef struct code {
    uint16_t words[FIXED_LITERALS]; /* first bit lowest */
    uint8_t bits[FIXED_LITERALS];
} code;

typedef struct deflater {
    uint32_t head[1 << HASH_BITS], previous[WINDOW]; /* positions + 1; 0: none */
    uint32_t symbols[BLOCK + CHUNK]; /* a literal, or length << 16 | distance of a match */
    uint32_t symbol_count;
    frequencies block, chunk;
    uint32_t block_count; /* symbols in `block`; those of `chunk` follow */
    code literals, distances;
    uint64_t bits;
    unsigned bit_count;
    uint8_t *out;
    size_t size, room; /* bytes of the output, which are counted, but not written, beyond `room` */
    uint8_t sample[SAMPLES * (SAMPLE + 1)];
} deflater;

typedef char work_is_large_enough[sizeof(deflater) <= CSPLAT_DEFLATE_WORK ? 1 : -1];

static const uint16_t length_base[] = {3,  4,  5,  6,  7,  8,  9,  10, 11,  13,  15,  17,  19,  23, 27,
                                       31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
static const uint8_t length_extra[] = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0};

static void put_bytes(deflater *d, unsigned count)
{
    for (unsigned i = 0; i < count; i++, d->bits >>= 8, d->size++)
        if (d->size < d->room)
            d->out[d->size] = (uint8_t)d->bits;
}

static inline void put_bits(deflater *d, uint32_t value, unsigned count)
{
    d->bits |= (uint64_t)value << d->bit_count;
    d->bit_count += count;
    if (d->bit_count >= 32) {
        put_bytes(d, 4);
        d->bit_count -= 32;
    }
}

static unsigned log2_floor(uint32_t value)
{
    unsigned result = 0;
    while (value >>= 1)
        result++;
    return result;
}

static unsigned length_symbol(unsigned length)
{
    unsigned rest = length - 3, bits;
    if (length == MATCH_MAX)
        return 28;
    if (rest < 8)
        return rest;
    bits = log2_floor(rest) - 2;
    return 4 * bits + (rest >> bits);
}

static unsigned distance_symbol(unsigned distance)
{
    unsigned rest = distance - 1, bits;
    if (rest < 4)
        return rest;
    bits = log2_floor(rest) - 1;
    return 2 * bits + (rest >> bits);
}

static unsigned distance_extra(unsigned symbol)
{
    return symbol < 4 ? 0 : symbol / 2 - 1;
}

/* Choose code lengths of at most `most` bits: Huffman's algorithm with two queues. If codewords are then cut to `most` bits, others
 * become longer until all fit. */
static void choose_lengths(const uint32_t *frequency, unsigned count, unsigned most, uint8_t *bits)
{
    uint32_t order[LITERALS], weight[2 * LITERALS], per_length[LITERALS + 1] = {0};
    uint16_t parent[2 * LITERALS], depth[2 * LITERALS];
    unsigned used = 0, inner, leaf = 0, node, total;
    uint64_t room = 0;
    memset(bits, 0, count);
    for (unsigned i = 0; i < count; i++)
        if (frequency[i])
            order[used++] = i;
    if (used < 3) {
        for (unsigned i = 0; i < used; i++)
            bits[order[i]] = 1;
        return;
    }
    for (unsigned gap = used / 2; gap; gap /= 2) /* Shell sort; by symbol where frequencies are equal */
        for (unsigned i = gap; i < used; i++) {
            uint32_t moved = order[i];
            unsigned j = i;
            for (; j >= gap; j -= gap) {
                uint32_t before = order[j - gap];
                if (frequency[before] < frequency[moved] || (frequency[before] == frequency[moved] && before < moved))
                    break;
                order[j] = before;
            }
            order[j] = moved;
        }
    for (unsigned i = 0; i < used; i++)
        weight[i] = frequency[order[i]];
    total = 2 * used - 1;
    inner = node = used;
    for (; node < total; node++) {
        weight[node] = 0;
        for (int child = 0; child < 2; child++) {
            unsigned taken = leaf < used && (inner >= node || weight[leaf] <= weight[inner]) ? leaf++ : inner++;
            weight[node] += weight[taken];
            parent[taken] = (uint16_t)node;
        }
    }
    depth[total - 1] = 0;
    for (unsigned i = total - 1; i-- > 0;) {
        depth[i] = (uint16_t)(depth[parent[i]] + 1);
        if (i < used)
            per_length[depth[i] < most ? depth[i] : most]++;
    }
    for (unsigned length = 1; length <= most; length++)
        room += (uint64_t)per_length[length] << (most - length);
    while (room > (UINT64_C(1) << most)) { /* lengthen a codeword by a bit, which makes room next to it for one of the longest */
        unsigned length = most - 1;
        while (!per_length[length])
            length--;
        per_length[length]--;
        per_length[length + 1] += 2;
        per_length[most]--;
        room--;
    }
    for (unsigned length = most, i = 0; length; length--)
        for (uint32_t n = per_length[length]; n; n--)
            bits[order[i++]] = (uint8_t)length;
}

/* Assign codewords to code lengths (RFC 1951, 3.2.2). */
static void assign_words(const uint8_t *bits, unsigned count, uint16_t *words)
{
    unsigned per_length[BITS_MAX + 1] = {0}, next[BITS_MAX + 2] = {0};
    for (unsigned i = 0; i < count; i++)
        per_length[bits[i]]++;
    per_length[0] = 0;
    for (unsigned length = 1; length <= BITS_MAX; length++)
        next[length + 1] = (next[length] + per_length[length]) << 1;
    for (unsigned i = 0; i < count; i++) {
        unsigned word = bits[i] ? next[bits[i]]++ : 0, reversed = 0;
        for (unsigned k = 0; k < bits[i]; k++)
            reversed |= (word >> k & 1) << (bits[i] - 1u - k);
        words[i] = (uint16_t)reversed;
    }
}

/* Estimate the bits of symbols, without extra bits: their entropy, with an approximate logarithm, and the codes. */
static double estimate_bits(const frequencies *f, const frequencies *more)
{
    double bits = HEADER_BITS;
    for (int of_distances = 0; of_distances < 2; of_distances++) {
        const uint32_t *a = of_distances ? f->distances : f->literals;
        const uint32_t *b = more == NULL ? NULL : of_distances ? more->distances : more->literals;
        unsigned count = of_distances ? DISTANCES : LITERALS;
        uint32_t total = 0;
        for (unsigned i = 0; i <= count; i++) {
            uint32_t n = i == count ? total : a[i] + (b ? b[i] : 0);
            if (n) {
                unsigned whole = log2_floor(n);
                double part = (double)n / (double)(UINT32_C(1) << whole) - 1.0;
                double logarithm = (double)whole + part * (1.3465 - 0.3465 * part);
                bits += (i == count ? 1.0 : -1.0) * (double)n * logarithm;
                total += i == count ? 0 : n;
            }
        }
    }
    return bits;
}

/* Encode code lengths with the symbols 16 to 18 for repetitions; a symbol is symbol | extra << 8. */
static unsigned pack_lengths(const uint8_t *lengths, unsigned count, uint16_t *packed)
{
    unsigned result = 0;
    for (unsigned i = 0, run; i < count; i += run) {
        for (run = 1; i + run < count && lengths[i + run] == lengths[i] && run < 138; run++)
            continue;
        if (lengths[i] == 0 && run >= 3)
            packed[result++] = (uint16_t)(run < 11 ? 17 | (run - 3) << 8 : 18 | (run - 11) << 8);
        else if (run >= 4) {
            run = run > 7 ? 7 : run;
            packed[result++] = lengths[i];
            packed[result++] = (uint16_t)(16 | (run - 4) << 8);
        } else {
            run = 1;
            packed[result++] = lengths[i];
        }
    }
    return result;
}

static void put_codes(deflater *d)
{
    static const uint8_t order[LENGTHS] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    uint8_t lengths[LITERALS + DISTANCES], bits[LENGTHS];
    uint16_t packed[LITERALS + DISTANCES], words[LENGTHS];
    uint32_t frequency[LENGTHS] = {0};
    unsigned literal_count = LITERALS, distance_count = DISTANCES, length_count = LENGTHS, packed_count;
    while (!d->literals.bits[literal_count - 1])
        literal_count--;
    while (distance_count > 1 && !d->distances.bits[distance_count - 1])
        distance_count--;
    memcpy(lengths, d->literals.bits, literal_count);
    memcpy(lengths + literal_count, d->distances.bits, distance_count);
    packed_count = pack_lengths(lengths, literal_count + distance_count, packed);
    for (unsigned i = 0; i < packed_count; i++)
        frequency[packed[i] & 255]++;
    frequency[0] += !frequency[0]; /* two codewords at least: COD-6 */
    frequency[1] += !frequency[1];
    choose_lengths(frequency, LENGTHS, LENGTH_BITS_MAX, bits);
    assign_words(bits, LENGTHS, words);
    while (length_count > 4 && !bits[order[length_count - 1]])
        length_count--;
    put_bits(d, literal_count - 257, 5);
    put_bits(d, distance_count - 1, 5);
    put_bits(d, length_count - 4, 4);
    for (unsigned i = 0; i < length_count; i++)
        put_bits(d, bits[order[i]], 3);
    for (unsigned i = 0; i < packed_count; i++) {
        unsigned symbol = packed[i] & 255;
        put_bits(d, words[symbol], bits[symbol]);
        if (symbol >= 16)
            put_bits(d, packed[i] >> 8, symbol == 16 ? 2 : symbol == 17 ? 3 : 7);
    }
}

/* Write the symbols of `block` and its end by the present codes. */
static void put_symbols(deflater *d)
{
    for (uint32_t i = 0; i < d->block_count; i++) {
        uint32_t symbol = d->symbols[i];
        if (symbol < 256) {
            put_bits(d, d->literals.words[symbol], d->literals.bits[symbol]);
            continue;
        }
        unsigned length = symbol >> 16, distance = symbol & 0xFFFF;
        unsigned by_length = length_symbol(length), by_distance = distance_symbol(distance);
        unsigned extra = distance_extra(by_distance);
        put_bits(d, d->literals.words[257 + by_length], d->literals.bits[257 + by_length]);
        put_bits(d, length - length_base[by_length], length_extra[by_length]);
        put_bits(d, d->distances.words[by_distance], d->distances.bits[by_distance]);
        put_bits(d, (distance - 1) & ((UINT32_C(1) << extra) - 1), extra);
    }
    put_bits(d, d->literals.words[END], d->literals.bits[END]);
}

/* Write `block` with codes of its own. */
static void put_dynamic_block(deflater *d, uint32_t is_last)
{
    choose_lengths(d->block.literals, LITERALS, BITS_MAX, d->literals.bits);
    choose_lengths(d->block.distances, DISTANCES, BITS_MAX, d->distances.bits);
    assign_words(d->literals.bits, LITERALS, d->literals.words);
    assign_words(d->distances.bits, DISTANCES, d->distances.words);
    put_bits(d, is_last | 2 << 1, 3);
    put_codes(d);
    put_symbols(d);
}

/* Write `block` with the codes of RFC 1951, 3.2.6, which are shorter than the description of others if there are few symbols. */
static void put_fixed_block(deflater *d, uint32_t is_last)
{
    for (unsigned i = 0; i < FIXED_LITERALS; i++)
        d->literals.bits[i] = i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : 8;
    memset(d->distances.bits, 5, DISTANCES);
    assign_words(d->literals.bits, FIXED_LITERALS, d->literals.words);
    assign_words(d->distances.bits, DISTANCES, d->distances.words);
    put_bits(d, is_last | 1 << 1, 3);
    put_symbols(d);
}

/* Write the symbols of `block` in the shorter way, and move those of `chunk` to its place. */
static void put_block(deflater *d, uint32_t is_last)
{
    const uint64_t bits = d->bits;
    const size_t size = d->size;
    const unsigned bit_count = d->bit_count;
    d->block.literals[END] = 1;
    put_dynamic_block(d, is_last);
    if (d->block_count < FIXED_SYMBOLS_MAX) {
        uint64_t dynamic = 8 * (uint64_t)d->size + d->bit_count;
        d->bits = bits, d->size = size, d->bit_count = bit_count;
        put_fixed_block(d, is_last);
        if (dynamic < 8 * (uint64_t)d->size + d->bit_count) {
            d->bits = bits, d->size = size, d->bit_count = bit_count;
            put_dynamic_block(d, is_last);
        }
    }
    d->symbol_count -= d->block_count;
    memmove(d->symbols, d->symbols + d->block_count, d->symbol_count * sizeof *d->symbols);
    d->block = d->chunk;
    d->block_count = d->symbol_count;
    memset(&d->chunk, 0, sizeof d->chunk);
}

/* Decide whether the last chunk belongs to the block. */
static void end_chunk(deflater *d)
{
    uint32_t chunk_count = d->symbol_count - d->block_count;
    if (d->block_count && (d->symbol_count > BLOCK || estimate_bits(&d->block, &d->chunk) >
                                                          estimate_bits(&d->block, NULL) + estimate_bits(&d->chunk, NULL))) {
        put_block(d, 0);
        return;
    }
    for (unsigned i = 0; i < LITERALS; i++)
        d->block.literals[i] += d->chunk.literals[i];
    for (unsigned i = 0; i < DISTANCES; i++)
        d->block.distances[i] += d->chunk.distances[i];
    memset(&d->chunk, 0, sizeof d->chunk);
    d->block_count += chunk_count;
}

static void add_literal(deflater *d, uint8_t byte)
{
    d->symbols[d->symbol_count++] = byte;
    d->chunk.literals[byte]++;
    if (d->symbol_count - d->block_count == CHUNK)
        end_chunk(d);
}

static void add_match(deflater *d, unsigned length, unsigned distance)
{
    d->symbols[d->symbol_count++] = (uint32_t)length << 16 | distance;
    d->chunk.literals[257 + length_symbol(length)]++;
    d->chunk.distances[distance_symbol(distance)]++;
    if (d->symbol_count - d->block_count == CHUNK)
        end_chunk(d);
}

static unsigned match_length(const uint8_t *a, const uint8_t *b, size_t most)
{
    unsigned length = 0;
    while (length < most && a[length] == b[length])
        length++;
    return length;
}

static uint32_t load32(const uint8_t *data)
{
    return data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 | (uint32_t)data[3] << 24;
}

static uint32_t *chain_of(deflater *d, uint32_t bytes)
{
    return &d->head[bytes * UINT32_C(2654435761) >> (32 - HASH_BITS)];
}

static void enter(deflater *d, const uint8_t *data, size_t at)
{
    uint32_t *head = chain_of(d, load32(data + at));
    d->previous[at % WINDOW] = *head;
    *head = (uint32_t)at + 1;
}

static void find_matches(deflater *d, const uint8_t *data, size_t size)
{
    memset(d->head, 0, sizeof d->head);
    for (size_t at = 0; at < size;) {
        unsigned best = MATCH_MIN - 1, distance = 0;
        if (size - at >= MATCH_MIN) {
            size_t most = size - at < MATCH_MAX ? size - at : MATCH_MAX;
            uint32_t bytes = load32(data + at), candidate = *chain_of(d, bytes);
            for (int tries = CHAIN_MAX; tries && candidate && at + 1 - candidate < WINDOW && best < most; tries--) {
                const uint8_t *before = data + candidate - 1;
                if (load32(before) == bytes && before[best] == data[at + best]) {
                    unsigned length = match_length(before, data + at, most);
                    if (length > best) {
                        best = length;
                        distance = (unsigned)(at + 1 - candidate);
                    }
                }
                uint32_t next = d->previous[(candidate - 1) % WINDOW];
                candidate = next < candidate ? next : 0;
            }
            enter(d, data, at);
        }
        if (best < MATCH_MIN) {
            add_literal(d, data[at++]);
            continue;
        }
        add_match(d, best, distance);
        for (size_t end = at + best; ++at < end;)
            if (size - at >= MATCH_MIN)
                enter(d, data, at);
    }
}

static void find_runs(deflater *d, const uint8_t *data, size_t size)
{
    for (size_t at = 0; at < size;) {
        unsigned run = at ? match_length(data + at - 1, data + at, size - at < MATCH_MAX ? size - at : MATCH_MAX) : 0;
        if (run < 3)
            add_literal(d, data[at++]);
        else {
            add_match(d, run, 1);
            at += run;
        }
    }
}

static size_t compress(deflater *d, method how, const uint8_t *data, size_t size, uint8_t *out, size_t room)
{
    memset(&d->block, 0, sizeof d->block);
    memset(&d->chunk, 0, sizeof d->chunk);
    d->symbol_count = d->block_count = 0;
    d->bits = 0;
    d->bit_count = 0;
    d->out = out;
    d->size = 0;
    d->room = room;
    if (how == CHAINS)
        find_matches(d, data, size);
    else if (how == RUNS)
        find_runs(d, data, size);
    else
        for (size_t at = 0; at < size; at++)
            add_literal(d, data[at]);
    end_chunk(d);
    put_block(d, 1);
    put_bytes(d, (d->bit_count + 7) / 8);
    return d->size;
}

size_t csplat_deflate(const uint8_t *data, size_t size, uint8_t *out, size_t room, void *work)
{
    deflater *d = work;
    method best = NO_MATCHES;
    size_t sample_size = 0, least = SIZE_MAX, step = size / SAMPLES > SAMPLE ? size / SAMPLES : SAMPLE;
    for (size_t start = 0; start < size; start += step) {
        size_t part = size - start < SAMPLE ? size - start : SAMPLE;
        memcpy(d->sample + sample_size, data + start, part);
        sample_size += part;
    }
    for (int how = CHAINS; how < METHODS; how++) {
        size_t result = compress(d, (method)how, d->sample, sample_size, NULL, 0);
        if (result < least) {
            least = result;
            best = (method)how;
        }
    }
    size = compress(d, best, data, size, out, room);
    return size > room ? 0 : size;
}
