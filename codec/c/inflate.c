/* SPDX-License-Identifier: Apache-2.0 */
/* An inflate for programs without zlib (-DCSPLAT_NO_ZLIB): raw DEFLATE (RFC 1951) with the rules of the specification,
 * 6.2. It allocates no memory and accesses no byte outside the two buffers.
 *
 * Codes are decoded with tables: the next ROOT bits index one, which points to smaller tables for longer codewords. */
#include "csplat.h"

#include <string.h>

enum { LITERALS = 288, DISTANCES = 32, LENGTHS = 19, BITS_MAX = 15 };
enum { LITERAL_ROOT = 11, DISTANCE_ROOT = 8, LENGTH_ROOT = 7 };
/* Maximum table entries for the numbers of symbols and root bits, as computed by zlib's program `enough`. */
enum { LITERAL_ENTRIES = 2342, DISTANCE_ENTRIES = 402, LENGTH_ENTRIES = 128 };

/* A table entry: bits of the codeword (0 to 4), extra bits (8 to 11), flags (5, 12 to 15), and a value above. The extra bits
 * of a SUBTABLE index it, and its value is its position; a PAIR is two literals. */
enum { LITERAL = 0x8000, SUBTABLE = 0x4000, END = 0x2000, WRONG = 0x1000, PAIR = 0x20 };

typedef struct code {
    uint32_t literals[LITERAL_ENTRIES], distances[DISTANCE_ENTRIES];
} code;

typedef struct reader {
    const uint8_t *at, *end;
    uint64_t bits; /* the next bits, lowest first; 0 after the end */
    int count;     /* number of valid bits; negative if more were taken */
} reader;

/* Provide at least 56 bits, unless the stream ends. */
static inline void refill(reader *r)
{
    if (r->end - r->at >= 8) {
        uint64_t next = 0;
        for (int i = 0; i < 8; i++) /* compiles to one load */
            next |= (uint64_t)r->at[i] << 8 * i;
        r->bits |= next << r->count;
        r->at += (63 - r->count) >> 3;
        r->count |= 56;
    } else
        while (r->count <= 56 && r->at < r->end) {
            r->bits |= (uint64_t)*r->at++ << r->count;
            r->count += 8;
        }
}

static inline uint32_t peek(const reader *r, unsigned count)
{
    return (uint32_t)r->bits & ((UINT32_C(1) << count) - 1);
}

static inline void skip(reader *r, unsigned count)
{
    r->bits >>= count;
    r->count -= (int)count;
}

static uint32_t number(reader *r, unsigned count)
{
    uint32_t value;
    refill(r);
    value = peek(r, count);
    skip(r, count);
    return value;
}

static uint32_t entry(const uint32_t *table, const reader *r, unsigned root)
{
    uint32_t e = table[peek(r, root)];
    if (e & SUBTABLE)
        e = table[(e >> 16) + ((uint32_t)(r->bits >> root) & ((1u << (e >> 8 & 15)) - 1))];
    return e;
}

/* The values of symbols. Lengths: 3 to 10 have a symbol each, then four symbols per number of extra bits (RFC 1951, 3.2.5). */
static uint32_t literal_entry(unsigned symbol)
{
    unsigned i = symbol - 257, extra = i < 8 ? 0 : i / 4 - 1;
    if (symbol < 256)
        return LITERAL | symbol << 16;
    if (symbol == 256)
        return END;
    if (symbol == 285)
        return 258u << 16;
    return symbol > 285 ? WRONG : extra << 8 | (3 + (i < 8 ? i : (4 + i % 4) << extra)) << 16;
}

static uint32_t distance_entry(unsigned symbol)
{
    unsigned extra = symbol < 4 ? 0 : symbol / 2 - 1;
    return symbol > 29 ? WRONG : extra << 8 | (1 + (symbol < 4 ? symbol : (2 + symbol % 2) << extra)) << 16;
}

static uint32_t length_entry(unsigned symbol)
{
    return symbol << 16;
}

/* Build the table of a code from the lengths of its codewords (COD-6). It may be incomplete if it has no codeword or one of
 * one bit, and at least `least` codewords. */
static int make_table(const uint8_t *lengths, unsigned symbols, uint32_t (*means)(unsigned), unsigned root, unsigned least,
                      uint32_t *table)
{
    unsigned counts[BITS_MAX + 1] = {0}, places[BITS_MAX + 2] = {0}, used = 0, reversed = 0, next = 1u << root;
    uint16_t order[LITERALS];
    uint32_t left = 1u << BITS_MAX; /* sequences of BITS_MAX bits without a codeword */
    for (unsigned i = 0; i < symbols; i++)
        counts[lengths[i]]++;
    counts[0] = 0;
    for (unsigned bits = 1; bits <= BITS_MAX; bits++) {
        uint32_t taken = (uint32_t)counts[bits] << (BITS_MAX - bits);
        if (taken > left)
            return 0;
        left -= taken;
        used += counts[bits];
        places[bits + 1] = used;
    }
    if (left && (used != counts[1] || used < least))
        return 0;
    for (unsigned i = 0; left && i < next; i++)
        table[i] = WRONG;
    for (unsigned i = 0; i < symbols; i++)
        if (lengths[i])
            order[places[lengths[i]]++] = (uint16_t)i;
    for (unsigned bits = 1, i = 0, sub = 0, prefix = ~0u; i < used; i++) {
        unsigned bit;
        uint32_t e;
        while (!counts[bits])
            bits++;
        e = means(order[i]) | bits;
        if (bits <= root)
            for (unsigned at = reversed; at < 1u << root; at += 1u << bits)
                table[at] = e;
        else {
            if ((reversed & ((1u << root) - 1)) != prefix) { /* a new subtable, sized for its codewords */
                int room;
                sub = bits - root;
                room = 1 << sub;
                while (sub + root < BITS_MAX && (room -= (int)counts[sub + root]) > 0) {
                    sub++;
                    room <<= 1;
                }
                prefix = reversed & ((1u << root) - 1);
                table[prefix] = SUBTABLE | sub << 8 | next << 16;
                next += 1u << sub;
            }
            for (unsigned at = reversed >> root; at < 1u << sub; at += 1u << (bits - root))
                table[(table[prefix] >> 16) + at] = e;
        }
        counts[bits]--;
        bit = 1u << (bits - 1); /* the next codeword, in reversed bit order */
        while (reversed & bit)
            bit >>= 1;
        reversed = bit ? (reversed & (bit - 1)) | bit : 0;
    }
    return 1;
}

/* Combine two literals in one entry if the bits that index the first also contain the second. */
static int pair_literals(uint32_t *table)
{
    for (unsigned i = 1u << LITERAL_ROOT; i-- > 0;) { /* downwards, so that the entry looked up is not a pair yet */
        uint32_t e = table[i], next = table[i >> (e & 31)], bits = (e & 31) + (next & 31);
        if (e & LITERAL && next & LITERAL && bits <= LITERAL_ROOT)
            table[i] = LITERAL | PAIR | bits | (e & 0xFF0000) | (next & 0xFF0000) << 8;
    }
    return 1;
}

static int fixed_code(code *c)
{
    uint8_t lengths[LITERALS];
    memset(lengths, 8, 144);
    memset(lengths + 144, 9, 112);
    memset(lengths + 256, 7, 24);
    memset(lengths + 280, 8, 8);
    make_table(lengths, LITERALS, literal_entry, LITERAL_ROOT, 2, c->literals);
    pair_literals(c->literals);
    memset(lengths, 5, DISTANCES);
    return make_table(lengths, DISTANCES, distance_entry, DISTANCE_ROOT, 2, c->distances);
}

/* Read the head of a dynamic block. */
static int dynamic_code(reader *r, code *c)
{
    static const uint8_t order[LENGTHS] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    uint8_t lengths[LITERALS + DISTANCES] = {0};
    const unsigned literals = 257 + number(r, 5), distances = 1 + number(r, 5), given = 4 + number(r, 4);
    if (literals > 286 || distances > 30) /* COD-5 */
        return 0;
    for (unsigned i = 0; i < given; i++)
        lengths[order[i]] = (uint8_t)number(r, 3);
    if (!make_table(lengths, LENGTHS, length_entry, LENGTH_ROOT, 2, c->literals))
        return 0;
    memset(lengths, 0, LENGTHS);
    for (unsigned i = 0; i < literals + distances;) {
        uint32_t e, symbol, times = 1;
        refill(r);
        e = c->literals[peek(r, LENGTH_ROOT)];
        symbol = e >> 16;
        skip(r, e & 31);
        if (symbol == 16)
            times = 3 + number(r, 2);
        else if (symbol == 17)
            times = 3 + number(r, 3);
        else if (symbol == 18)
            times = 11 + number(r, 7);
        if (r->count < 0 || (symbol == 16 && i == 0) || times > literals + distances - i) /* COD-7 */
            return 0;
        memset(lengths + i, symbol < 16 ? (int)symbol : symbol == 16 ? lengths[i - 1] : 0, times);
        i += times;
    }
    return lengths[256] && make_table(lengths, literals, literal_entry, LITERAL_ROOT, 1, c->literals) &&
           pair_literals(c->literals) &&
           make_table(lengths + literals, distances, distance_entry, DISTANCE_ROOT, 0, c->distances);
}

/* Copy `length` bytes from `distance` back, in order, since the two ranges may overlap. */
static inline void copy_match(uint8_t *to, size_t distance, size_t length, size_t room)
{
    const uint8_t *from = to - distance;
    if (distance >= 16 && room >= length + 16)
        for (size_t i = 0; i < length; i += 16)
            memcpy(to + i, from + i, 16);
    else if (distance == 1)
        memset(to, *from, length);
    else
        for (size_t i = 0; i < length; i++)
            to[i] = from[i];
}

/* Write one literal or two and return how many; always writes two bytes. */
static inline size_t put_literals(reader *r, uint32_t e, uint8_t *out)
{
    skip(r, e & 31);
    out[0] = (uint8_t)(e >> 16);
    out[1] = (uint8_t)(e >> 24);
    return 1 + (e >> 5 & 1);
}

/* Decode the data of a fixed or dynamic block; return the new end of the output, or `wrong`. */
static size_t block_data(reader *reading, const code *c, uint8_t *out, size_t at, size_t size, size_t wrong)
{
    reader r = *reading;
    for (;;) {
        size_t length, distance;
        uint32_t e;
        refill(&r);
        e = entry(c->literals, &r, LITERAL_ROOT);
        if (e & LITERAL && size - at >= 6) { /* at most three times 15 bits and two bytes */
            at += put_literals(&r, e, out + at);
            e = entry(c->literals, &r, LITERAL_ROOT);
            if (e & LITERAL) {
                at += put_literals(&r, e, out + at);
                e = entry(c->literals, &r, LITERAL_ROOT);
            }
        }
        if (e & LITERAL) {
            if (size - at >= 2)
                at += put_literals(&r, e, out + at);
            else if (at < size && !(e & PAIR)) {
                skip(&r, e & 31);
                out[at++] = (uint8_t)(e >> 16);
            } else
                return wrong;
            if (r.count < 0)
                return wrong;
            continue;
        }
        skip(&r, e & 31);
        if (r.count < 0 || e & WRONG)
            return wrong;
        if (e & END)
            break;
        refill(&r);
        length = (e >> 16) + peek(&r, e >> 8 & 15);
        skip(&r, e >> 8 & 15);
        e = entry(c->distances, &r, DISTANCE_ROOT);
        skip(&r, e & 31);
        distance = (e >> 16) + peek(&r, e >> 8 & 15);
        skip(&r, e >> 8 & 15);
        if (r.count < 0 || e & WRONG || distance > at || length > size - at)
            return wrong;
        copy_match(out + at, distance, length, size - at);
        at += length;
    }
    *reading = r;
    return at;
}

/* Copy a stored block. */
static size_t stored_data(reader *r, uint8_t *out, size_t at, size_t size, size_t wrong)
{
    size_t length, complement;
    skip(r, (unsigned)r->count & 7);
    length = number(r, 16);
    complement = number(r, 16);
    if (r->count < 0 || length + complement != 0xFFFF || length > size - at)
        return wrong;
    r->at -= r->count >> 3; /* bytes already in `bits` */
    r->bits = 0;
    r->count = 0;
    if (length > (size_t)(r->end - r->at))
        return wrong;
    memcpy(out + at, r->at, length);
    r->at += length;
    return at + length;
}

int csplat_inflate(void *user, const uint8_t *coded, size_t coded_size, uint8_t *out, size_t size)
{
    const size_t wrong = size + 1;
    reader r = {coded, coded + coded_size, 0, 0};
    code c;
    size_t at = 0;
    uint32_t head;
    (void)user;
    do {
        head = number(&r, 3);
        if (r.count < 0)
            return 0;
        switch (head >> 1) {
        case 0:
            at = stored_data(&r, out, at, size, wrong);
            break;
        case 1:
            at = fixed_code(&c) ? block_data(&r, &c, out, at, size, wrong) : wrong;
            break;
        case 2:
            at = dynamic_code(&r, &c) ? block_data(&r, &c, out, at, size, wrong) : wrong;
            break;
        default:
            at = wrong;
        }
        if (at == wrong)
            return 0;
    } while (!(head & 1));
    return at == size && r.at == r.end && r.count < 8;
}
