/* SPDX-License-Identifier: Apache-2.0 */
/* Reads PLYs of splats for the encoder; spec/encoders.md (5.6, E.1) describes their contents. Values equal those of csplat.read in
 * Python. */
#include "csplat_encode.h"

#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#elif defined __GNUC__
#pragma GCC optimize("no-tree-vectorize") /* as in csplat_encode.c */
#endif

enum { HEADER_MAX = 1 << 20, PROPERTIES_MAX = 4096, WORDS_MAX = 6, WORD_MAX = 64, VALUES_MAX = 72 };
enum { DIGITS_MAX = 800, SHIFT_MAX = 60, SHIFT_DIGITS = 20 }; /* of decimal numbers; the largest shift, and the digits it adds */
static const int64_t EXPONENT_MAX = (int64_t)1 << 40;         /* of decimal numbers, larger than the size of a file */
enum { X, QUAT = 3, SCALE = 7, OPACITY = 10, DC = 11, REST = 14, COLUMNS = REST + VALUES_MAX };

typedef enum type { NO_TYPE, INT8, UINT8, INT16, UINT16, INT32, UINT32, FLOAT, DOUBLE } type;

typedef struct property {
    type kind, count_kind; /* of values, and of the number of values; NO_TYPE: a single value */
    int column;            /* X to COLUMNS - 1, or -1 */
} property;

typedef enum encoding { TEXT, LITTLE, BIG } encoding;

typedef struct word {
    const char *at;
    size_t size;
} word;

/* What commas of a text are: parts of words, decimal commas (between digits; semicolons are spaces), or spaces like semicolons. */
typedef enum commas { PLAIN, DECIMAL, SPACES } commas;

/* An element of a text. */
typedef struct element {
    uint64_t count; /* rows */
    unsigned width; /* properties */
    int has_lists, is_in_lines; /* each row is a line */
} element;

typedef struct reader {
    const uint8_t *at, *end;
    encoding form;
    csplat_error *error;
    csplat_encode_options options;
    csplat_ply *out;
    property properties[PROPERTIES_MAX]; /* of the current element */
    unsigned property_count, rest_count;
    size_t line; /* number of the header line, or of the text's last word */
    commas commas;
    element elements[PROPERTIES_MAX]; /* of a text */
    unsigned element_count;
    int has_double, has_origin, adds_origin;
    unsigned char found[COLUMNS + 1]; /* columns, and beyond */
} reader;

#define TRY(call)     \
    do {              \
        if (!(call))  \
            return 0; \
    } while (0)

/* Note an error and evaluate to 0, which functions return on failure. */
#define fail(...) (note(__VA_ARGS__), 0)

static void note(reader *r, csplat_code code, const char *format, ...)
{
    va_list arguments;
    r->error->code = code;
    va_start(arguments, format);
    vsnprintf(r->error->message, sizeof r->error->message, format, arguments);
    va_end(arguments);
}

static void *plain_allocate(void *user, size_t size)
{
    (void)user;
    return malloc(size);
}

static void plain_release(void *user, void *data)
{
    (void)user;
    free(data);
}

static int is_space(int c)
{
    return c == ' ' || c == '\t' || c == '\n' || c == '\r' || c == '\f' || c == '\v';
}

static int is_word(word w, const char *text)
{
    return strlen(text) == w.size && memcmp(w.at, text, w.size) == 0;
}

/* Copy a word for messages, cut to WORD_MAX - 1 characters. */
static const char *text_of(word w, char buffer[WORD_MAX])
{
    size_t size = w.size < WORD_MAX - 1 ? w.size : WORD_MAX - 1;
    for (size_t i = 0; i < size; i++)
        buffer[i] = w.at[i] >= ' ' && w.at[i] <= '~' ? w.at[i] : '?';
    buffer[size] = 0;
    return buffer;
}

/* A decimal number: 0.d1d2d3… · 10^point. Digits beyond DIGITS_MAX decide only if they are not all 0: binary64 and the middles
 * between its numbers have at most 767 digits. */
typedef struct decimal {
    uint8_t digits[DIGITS_MAX + SHIFT_DIGITS];
    int count, is_cut;
    int64_t point;
} decimal;

static void trim(decimal *d)
{
    while (d->count && !d->digits[d->count - 1])
        d->count--;
    d->point = d->count ? d->point : 0;
}

/* Multiply by 2^k, k up to SHIFT_MAX. */
static void shift_left(decimal *d, int k)
{
    uint8_t made[DIGITS_MAX + SHIFT_DIGITS];
    int at = DIGITS_MAX + SHIFT_DIGITS, old = d->count;
    uint64_t carry = 0;
    for (int i = old - 1; i >= 0 || carry; i--) {
        carry += i >= 0 ? (uint64_t)d->digits[i] << k : 0;
        made[--at] = (uint8_t)(carry % 10);
        carry /= 10;
    }
    d->count = DIGITS_MAX + SHIFT_DIGITS - at;
    d->point += d->count - old;
    memcpy(d->digits, made + at, (size_t)d->count);
    for (; d->count > DIGITS_MAX; d->count--)
        d->is_cut |= d->digits[d->count - 1] != 0;
    trim(d);
}

/* Divide by 2^k, k up to SHIFT_MAX. */
static void shift_right(decimal *d, int k)
{
    const uint64_t mask = ((uint64_t)1 << k) - 1;
    uint64_t rest = 0;
    int from = 0, to = 0;
    for (; !(rest >> k); from++) {
        if (from >= d->count && !rest) {
            d->count = 0;
            d->point = 0;
            return;
        }
        rest = 10 * rest + (from < d->count ? d->digits[from] : 0);
    }
    d->point -= from - 1;
    while (from < d->count || rest) {
        uint8_t digit = (uint8_t)(rest >> k);
        rest = 10 * (rest & mask) + (from < d->count ? d->digits[from] : 0);
        from++;
        if (to < DIGITS_MAX)
            d->digits[to++] = digit;
        else
            d->is_cut |= digit != 0;
    }
    d->count = to;
    trim(d);
}

/* Round a number below 2^54 to the nearest integer, halves to even. */
static uint64_t round_decimal(const decimal *d)
{
    uint64_t whole = 0;
    int i = 0, is_above;
    for (; i < d->point; i++)
        whole = 10 * whole + (i < d->count ? d->digits[i] : 0);
    if (d->point < 0 || i >= d->count)
        return whole;
    is_above = d->digits[i] > 5 || (d->digits[i] == 5 && (i + 1 < d->count || d->is_cut));
    return whole + (uint64_t)(is_above || (d->digits[i] == 5 && whole % 2));
}

/* Return the nearest binary64 of a decimal number, halves to even. Shifts scale it to 2^52 to 2^53, or less if it is subnormal. */
static double nearest_double(decimal *d)
{
    static const uint8_t powers[] = {0, 3, 6, 9, 13, 16, 19, 23, 26, 29, 33, 36, 39, 43, 46, 49, 53, 56, 59};
    int exponent = 0, count = (int)sizeof powers;
    if (!d->count || d->point < -330)
        return 0.0;
    if (d->point > 310)
        return HUGE_VAL;
    while (d->point > 0) {
        int k = d->point < count ? powers[d->point] : SHIFT_MAX;
        k = k ? k : 1;
        shift_right(d, k);
        exponent += k;
    }
    while (d->count && (d->point < 0 || d->digits[0] < 5)) {
        int k = -d->point < count ? powers[-d->point] : SHIFT_MAX;
        k = k ? k : 1;
        shift_left(d, k);
        exponent -= k;
    }
    if (exponent < -1021) { /* 0.5 to 1, times 2^exponent: subnormal */
        for (int k = -1021 - exponent; k > 0; k -= SHIFT_MAX)
            shift_right(d, k < SHIFT_MAX ? k : SHIFT_MAX);
        exponent = -1021;
    }
    shift_left(d, 53);
    return ldexp((double)round_decimal(d), exponent - 53);
}

static int is_digit(int c)
{
    return c >= '0' && c <= '9';
}

/* Return whether `size` characters are a text in small letters, in any case, with any number of zeros after it. */
static int is_spelled(const char *at, size_t size, const char *text)
{
    for (; size && *text; at++, text++, size--)
        if ((*at >= 'A' && *at <= 'Z' ? *at - 'A' + 'a' : *at) != *text)
            return 0;
    for (; size && *at == '0'; at++)
        size--;
    return !size && !*text;
}

/* Parse infinity or NaN without a sign, as C, Python and Microsoft's C write them. */
static int parse_name(const char *at, size_t size, double *value)
{
    static const char *const names[] = {"inf", "infinity", "1.#inf", "nan", "1.#ind", "1.#qnan", "1.#snan"};
    for (size_t i = 0; i < sizeof names / sizeof *names; i++) {
        *value = i < 3 ? HUGE_VAL : (double)NAN;
        if (is_spelled(at, size, names[i]))
            return names[i][0] == '1' || at[size - 1] != '0';
    }
    if (size < 5 || !is_spelled(at, 3, "nan") || at[3] != '(' || at[size - 1] != ')')
        return 0;
    for (size_t i = 4; i < size - 1; i++)
        if (!((at[i] >= 'a' && at[i] <= 'z') || (at[i] >= 'A' && at[i] <= 'Z')))
            return 0;
    return 1;
}

/* Parse a number that is the whole word: digits with a point or not, an exponent after e or E or none, or infinity or NaN; in any
 * locale, the nearest binary64. `comma`: ',' is a decimal point, too; 0: without exponents after d or D, as Fortran writes them. */
static int parse_number(word w, char comma, double *value)
{
    static const double powers[] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,  1e8,  1e9,  1e10, 1e11,
                                    1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};
    const char *at = w.at, *end = w.at + w.size, *first;
    int is_negative = w.size && *at == '-', has_digits = 0, has_point = 0, is_negative_exponent = 0;
    uint64_t whole = 0;
    int64_t exponent = 0, shift;
    decimal d;
    d.count = d.is_cut = 0;
    d.point = 0;
    at += w.size && (*at == '-' || *at == '+');
    first = at;
    for (; at < end; at++) {
        if (is_digit(*at)) {
            has_digits = 1;
            if (*at != '0' || d.count) {
                d.point += !has_point;
                whole = d.count < 19 ? 10 * whole + (uint64_t)(*at - '0') : whole;
                if (d.count < DIGITS_MAX)
                    d.digits[d.count++] = (uint8_t)(*at - '0');
                else
                    d.is_cut |= *at != '0';
            } else
                d.point -= has_point;
        } else if (!has_point && (*at == '.' || (*at == ',' && comma == ',' && has_digits && at + 1 < end && is_digit(at[1]))))
            has_point = 1;
        else
            break;
    }
    if (!has_digits || at < end)
        if (!has_digits || !(*at == 'e' || *at == 'E' || (comma && (*at == 'd' || *at == 'D')))) {
            TRY(parse_name(first, (size_t)(end - first), value));
            *value = is_negative ? -*value : *value;
            return 1;
        }
    if (at < end) {
        is_negative_exponent = ++at < end && *at == '-';
        at += at < end && (*at == '-' || *at == '+');
        TRY(at < end);
        for (; at < end; at++) {
            TRY(is_digit(*at));
            exponent = exponent < EXPONENT_MAX ? 10 * exponent + (*at - '0') : exponent;
        }
    }
    d.point += is_negative_exponent ? -exponent : exponent;
    shift = d.point - d.count;
    if (d.count <= 15 && shift >= -22 && shift <= 22) /* both numbers are exact, so that the result is rounded once */
        *value = shift < 0 ? (double)whole / powers[-shift] : (double)whole * powers[shift];
    else {
        trim(&d);
        *value = nearest_double(&d);
    }
    *value = is_negative ? -*value : *value;
    return 1;
}

static int parse_count(word w, uint64_t *count)
{
    *count = 0;
    TRY(w.size && w.size <= 18);
    for (size_t i = 0; i < w.size; i++) {
        TRY(w.at[i] >= '0' && w.at[i] <= '9');
        *count = 10 * *count + (uint64_t)(w.at[i] - '0');
    }
    return 1;
}

/* Return whether a word is an integer of a type. */
static int is_integer(word w, type kind)
{
    static const uint32_t limits[] = {0, 127, 255, 32767, 65535, INT32_MAX, UINT32_MAX};
    size_t first = w.size && (w.at[0] == '-' || w.at[0] == '+');
    uint64_t value = 0, most = limits[kind];
    if (first && w.at[0] == '-')
        most = kind == INT8 || kind == INT16 || kind == INT32 ? most + 1 : 0;
    for (size_t i = first; i < w.size; i++) {
        TRY(is_digit(w.at[i]));
        value = value <= most ? 10 * value + (uint64_t)(w.at[i] - '0') : value;
    }
    return w.size > first && value <= most;
}

static type type_of(word w)
{
    static const char *const names[][2] = {{"", ""},           {"char", "int8"},     {"uchar", "uint8"},
                                           {"short", "int16"}, {"ushort", "uint16"}, {"int", "int32"},
                                           {"uint", "uint32"}, {"float", "float32"}, {"double", "float64"}};
    for (int kind = INT8; kind <= DOUBLE; kind++)
        if (is_word(w, names[kind][0]) || is_word(w, names[kind][1]))
            return (type)kind;
    return NO_TYPE;
}

static size_t size_of(type kind)
{
    static const uint8_t sizes[] = {0, 1, 1, 2, 2, 4, 4, 4, 8};
    return sizes[kind];
}

static const char *const column_names[REST] = {"x",       "y",       "z",       "rot_0",   "rot_1",  "rot_2",  "rot_3",
                                               "scale_0", "scale_1", "scale_2", "opacity", "f_dc_0", "f_dc_1", "f_dc_2"};

/* Return the column of a property, -1 if splats do not use it, and COLUMNS for an f_rest that no degree has. */
static int column_of(word name)
{
    word digits = {name.at, 0};
    uint64_t number;
    for (int column = X; column < REST; column++)
        if (is_word(name, column_names[column]))
            return column;
    if (name.size < 8 || memcmp(name.at, "f_rest_", 7))
        return -1;
    digits.at += 7;
    digits.size = name.size - 7;
    if (!parse_count(digits, &number))
        return -1;
    return number < VALUES_MAX && (digits.at[0] != '0' || digits.size == 1) ? REST + (int)number : COLUMNS;
}

/* Split the next line of the header into its first words. Lines end in LF or CR LF. */
static int next_line(reader *r, word words[WORDS_MAX], unsigned *count)
{
    const uint8_t *end = r->at;
    *count = 0;
    while (end < r->end && *end != '\n')
        end++;
    if (end == r->end)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: the PLY header has no line end_header");
    r->line++;
    for (const uint8_t *p = r->at; *count < WORDS_MAX; ++*count) {
        while (p < end && is_space(*p))
            p++;
        if (p == end)
            break;
        words[*count].at = (const char *)p;
        while (p < end && !is_space(*p))
            p++;
        words[*count].size = (size_t)((const char *)p - words[*count].at);
    }
    r->at = end + 1;
    return 1;
}

static int bad_comment(reader *r, word key)
{
    char name[WORD_MAX];
    return fail(r, CSPLAT_E_INPUT, "E_INPUT: the value of the header comment 'csplat %s' is invalid", text_of(key, name));
}

/* Read a comment, split after the word `comment`. */
static int read_comment(reader *r, const word *words, unsigned count)
{
    csplat_splats *s = &r->out->splats;
    const word key = words[1];
    double numbers[3] = {0};
    if (count >= 2 && is_word(words[0], "SplatRenderMode:")) {
        s->antialiased |= is_word(key, "mip");
        s->flat |= is_word(key, "2dgs");
    } else if (count == 2 && is_word(words[0], "antialiased"))
        s->antialiased |= is_word(key, "1");
    if (count < 2 || !is_word(words[0], "csplat"))
        return 1;
    s->antialiased |= is_word(key, "antialiased");
    s->flat |= is_word(key, "flat");
    if (is_word(key, "origin") || is_word(key, "absolute_origin")) {
        for (unsigned i = 0; i < 3; i++)
            if (count != 5 || !parse_number(words[2 + i], 0, &numbers[i]) || !(fabs(numbers[i]) <= DBL_MAX))
                return bad_comment(r, key);
        memcpy(s->origin, numbers, sizeof numbers);
        r->has_origin = 1;
        r->adds_origin = is_word(key, "absolute_origin");
    } else if (is_word(key, "unit_metres")) {
        if (count != 3 || !parse_number(words[2], 0, &s->unit_metres) || !(s->unit_metres > 0.0 && s->unit_metres <= DBL_MAX))
            return bad_comment(r, key);
    } else if (is_word(key, "coordinate_system")) {
        if (count != 3 || words[2].size != 3) /* csplat_encode checks the letters */
            return bad_comment(r, key);
        memcpy(s->axes, words[2].at, 3);
    } else if (is_word(key, "colour_space")) {
        s->colour_space = count == 3 && is_word(words[2], "lin_rec709_display");
        if (count != 3 || !(s->colour_space || is_word(words[2], "srgb_rec709_display")))
            return bad_comment(r, key);
    }
    return 1;
}

/* Add a property to the current element. */
static int read_property(reader *r, const word *words, unsigned count, int is_splats)
{
    int is_list = count == 5 && is_word(words[1], "list");
    property *p = &r->properties[r->property_count];
    char name[WORD_MAX];
    if (r->property_count == PROPERTIES_MAX)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: the PLY header declares more than %u properties", (unsigned)PROPERTIES_MAX);
    p->kind = type_of(words[is_list ? 3 : 1]);
    p->count_kind = is_list ? type_of(words[2]) : NO_TYPE;
    p->column = -1;
    if ((!is_list && count != 3) || p->kind == NO_TYPE || (is_list && (p->count_kind == NO_TYPE || p->count_kind >= FLOAT)))
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: line %lu of the PLY header is no property", (unsigned long)r->line);
    r->property_count++;
    if (!is_splats)
        return 1;
    p->column = column_of(words[count - 1]);
    if (is_word(words[count - 1], "filter_3D"))
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: filter_3D is the 3D filter of Mip-Splatting, which this reader cannot fuse");
    if (p->column < 0)
        return 1;
    if (is_list || p->kind < FLOAT)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: column %s has no type of floats", text_of(words[count - 1], name));
    if (r->found[p->column] && p->column < COLUMNS)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: column %s occurs twice", text_of(words[2], name));
    r->found[p->column] = 1;
    r->rest_count += p->column >= REST;
    r->has_double |= p->column < QUAT && p->kind == DOUBLE;
    return 1;
}

static uint64_t load(const reader *r, const uint8_t *p, size_t size)
{
    uint64_t value = 0;
    for (size_t i = 0; i < size; i++)
        value |= (uint64_t)p[i] << 8 * (r->form == LITTLE ? i : size - 1 - i);
    return value;
}

/* Return whether a character is between the words of a line. */
static int is_gap(const reader *r, int c)
{
    return (is_space(c) && c != '\n' && c != '\r') || (c == ';' && r->commas != PLAIN) || (c == ',' && r->commas == SPACES);
}

/* Skip an end of a line, CR LF, CR or LF. */
static void skip_line_end(reader *r)
{
    r->at += r->at[0] == '\r' && r->end - r->at > 1 && r->at[1] == '\n' ? 2 : 1;
    r->line++;
}

/* Return the next word of a text, empty at its end. */
static word next_word(reader *r)
{
    word w;
    while (r->at < r->end && (is_gap(r, *r->at) || *r->at == '\n' || *r->at == '\r'))
        if (is_gap(r, *r->at))
            r->at++;
        else
            skip_line_end(r);
    w.at = (const char *)r->at;
    while (r->at < r->end && !is_gap(r, *r->at) && *r->at != '\n' && *r->at != '\r')
        r->at++;
    w.size = (size_t)((const char *)r->at - w.at);
    return w;
}

/* Go to the end of the next line that is not blank, and return the number of its words, 0 at the end of the text. */
static uint64_t skip_line(reader *r)
{
    uint64_t count = 0;
    for (int is_inside = 0; r->at < r->end; r->at++) {
        if (*r->at == '\n' || *r->at == '\r') {
            if (count)
                return count;
            skip_line_end(r);
            r->at--;
            is_inside = 0;
        } else {
            count += !is_inside && !is_gap(r, *r->at);
            is_inside = !is_gap(r, *r->at);
        }
    }
    return count;
}

/* Skip the rows of an element that is in lines of its own, or else as many words. */
static void skip_text(reader *r, const element *e)
{
    for (uint64_t words = 0, lines = 0; e->is_in_lines ? lines < e->count : words < e->width * e->count; lines++)
        words += skip_line(r);
}

/* Check that rows have the declared number of values: that each is a line, or else that every end of a line is one of a row, or
 * every end of a row one of a line, so that no missing value shifts others. */
static int check_layout(reader *r)
{
    uint64_t line_count = 0, row_count = 0;
    for (unsigned i = 0; i < r->element_count; i++) {
        element *e = &r->elements[i];
        const uint8_t *start = r->at;
        const size_t start_line = r->line;
        uint64_t row = 0, words = e->width, total = 0, lines = 0, common = 0;
        size_t line;
        if (!e->width && e->count)
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: an element of the PLY has rows, but no properties");
        row_count += e->count;
        for (; row < e->count && (words = skip_line(r)) && (e->has_lists || words == e->width); row++)
            ;
        e->is_in_lines = row == e->count;
        line_count += e->is_in_lines ? e->count : 0;
        if (e->is_in_lines)
            continue;
        if (!words)
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: the file is cut off in row %lu", (unsigned long)row);
        line = r->line;
        r->at = start;
        r->line = start_line;
        while (total < e->width * e->count && (words = skip_line(r))) {
            total += words;
            lines++;
            common += total % e->width == 0;
        }
        if (total != e->width * e->count || (common != e->count && common != lines)) {
            r->at = start;
            r->line = start_line;
            for (uint64_t before = 0; before <= row; before++)
                words = skip_line(r);
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: line %lu: row %lu has %lu values, expected %u", (unsigned long)line,
                        (unsigned long)row, (unsigned long)words, e->width);
        }
        line_count += lines;
    }
    if (line_count != row_count && skip_line(r))
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: line %lu: values follow rows that are not on separate lines",
                    (unsigned long)r->line);
    return 1;
}

/* Find out what commas of a text are: what its rows fit. */
static int find_layout(reader *r)
{
    const uint8_t *start = r->at;
    const size_t start_line = r->line;
    int has_commas = 0, has_point = 0, has_fraction = 0;
    commas tries[3];
    unsigned count = 0;
    csplat_error first;
    for (const uint8_t *p = start; p < r->end; p++) {
        int digits = 0;
        has_commas |= *p == ',' || *p == ';';
        has_point |= *p == '.' && (p + 1 == r->end || p[1] != '#');
        if (*p != ',' || p == start || !is_digit(p[-1]))
            continue;
        while (digits < 4 && r->end - p > digits + 1 && is_digit(p[digits + 1]))
            digits++;
        has_fraction |= digits && digits != 3; /* three digits: a thousand? */
    }
    if (has_commas && !has_point && has_fraction)
        tries[count++] = DECIMAL;
    if (has_commas)
        tries[count++] = SPACES;
    tries[count++] = PLAIN;
    for (unsigned i = 0; i < count; i++) {
        r->commas = tries[i];
        r->at = start;
        r->line = start_line;
        if (check_layout(r)) {
            r->error->code = CSPLAT_OK;
            r->error->message[0] = 0;
            r->at = start;
            r->line = start_line;
            return 1;
        }
        if (!i)
            first = *r->error;
    }
    *r->error = first;
    return 0;
}

static double convert(uint64_t bits, type kind)
{
    uint32_t narrow = (uint32_t)bits;
    float single;
    double number;
    if (kind == DOUBLE) {
        memcpy(&number, &bits, sizeof number);
        return number;
    }
    memcpy(&single, &narrow, sizeof single);
    return single;
}

/* Read the next row of splats of a text, and the values of its columns; `row` is its number, for messages. */
static int read_text_row(reader *r, const element *e, double *values, uint64_t row)
{
    const uint8_t *start = r->at;
    const size_t start_line = r->line;
    const uint64_t words = e->has_lists ? skip_line(r) : e->width;
    size_t line = r->line; /* where the row begins */
    uint64_t left = words;
    r->at = start;
    r->line = start_line;
    for (unsigned i = 0; i < r->property_count; i++, left--) {
        const property *p = &r->properties[i];
        double number = 0.0;
        uint64_t length;
        char text[WORD_MAX];
        word w = {"", 0};
        if (left)
            w = next_word(r);
        line = i ? line : r->line;
        if (left && p->count_kind != NO_TYPE && parse_count(w, &length) && length < left)
            for (left -= length; length; length--)
                next_word(r);
        else if (!left || p->count_kind != NO_TYPE)
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: line %lu: row %lu has %lu values, which its properties do not match",
                        (unsigned long)line, (unsigned long)row, (unsigned long)words);
        else if (p->kind < FLOAT ? !is_integer(w, p->kind) : !parse_number(w, r->commas == DECIMAL ? ',' : '.', &number))
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: line %lu: row %lu contains '%s', expected %s", (unsigned long)line,
                        (unsigned long)row, text_of(w, text), p->kind < FLOAT ? "an integer of its type" : "a number");
        if (p->column >= 0)
            values[p->column] = p->kind == DOUBLE ? number : (double)(float)number;
    }
    if (left)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: line %lu: row %lu has %lu values, which its properties do not match",
                    (unsigned long)line, (unsigned long)row, (unsigned long)words);
    return 1;
}

/* Read the next row of an element that is no text, and the values of its columns; `row` is its number, for messages. */
static int read_row(reader *r, double *values, uint64_t row)
{
    for (unsigned i = 0; i < r->property_count; i++) {
        const property *p = &r->properties[i];
        uint64_t count = 1;
        size_t size = size_of(p->kind), count_size = size_of(p->count_kind);
        if ((size_t)(r->end - r->at) < count_size)
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: the file is cut off in row %lu", (unsigned long)row);
        if (p->count_kind != NO_TYPE) {
            count = load(r, r->at, count_size);
            r->at += count_size;
        }
        if ((size_t)(r->end - r->at) / size < count)
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: the file is cut off in row %lu", (unsigned long)row);
        if (p->column >= 0)
            values[p->column] = convert(load(r, r->at, size), p->kind);
        r->at += count * size;
    }
    return 1;
}

/* Return the least number of bytes of a row. */
static uint64_t least_row(const reader *r)
{
    uint64_t size = 0;
    for (unsigned i = 0; i < r->property_count; i++) {
        const property *p = &r->properties[i];
        size += size_of(p->count_kind == NO_TYPE ? p->kind : p->count_kind);
    }
    return size;
}

/* Check that an element can have that many rows. */
static int check_rows(reader *r, uint64_t count)
{
    uint64_t size = least_row(r), left = (uint64_t)(r->end - r->at);
    if (size ? count > left / size : count > UINT32_MAX)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: the file is cut off: it has no room for its rows");
    return 1;
}

static int skip_rows(reader *r, uint64_t count)
{
    double unused[COLUMNS + 1];
    int has_list = 0;
    TRY(check_rows(r, count));
    for (unsigned i = 0; i < r->property_count; i++)
        has_list |= r->properties[i].count_kind != NO_TYPE;
    if (!has_list) {
        r->at += count * least_row(r);
        return 1;
    }
    for (uint64_t i = 0; i < count && r->property_count; i++)
        TRY(read_row(r, unused, i));
    return 1;
}

static int check_columns(reader *r)
{
    static const uint8_t counts[] = {0, 9, 24, 45, 72};
    unsigned degree = 0;
    for (int column = X; column < REST; column++)
        if (!r->found[column])
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: the PLY has no column %s, expected a PLY of Gaussian splats",
                        column_names[column]);
    while (degree < CSPLAT_SH_DEGREE_MAX && counts[degree] != r->rest_count)
        degree++;
    for (unsigned i = 0; i < r->rest_count && i < VALUES_MAX; i++)
        if (!r->found[REST + i])
            degree = CSPLAT_SH_DEGREE_MAX + 1;
    if (degree > CSPLAT_SH_DEGREE_MAX || counts[degree] != r->rest_count)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: %u columns f_rest match no SH degree from 0 to %u", r->rest_count,
                    (unsigned)CSPLAT_SH_DEGREE_MAX);
    r->out->splats.sh_degree = degree;
    return 1;
}

/* Convert a row to a splat; return 0 if it is none (SRC-1). */
static int convert_row(const reader *r, const double *values, float *const arrays[6], double *position, size_t at)
{
    unsigned coefficients = r->rest_count / 3;
    float *means = arrays[0] + 3 * at, *quats = arrays[1] + 4 * at, *scales = arrays[2] + 3 * at, *sh0 = arrays[4] + 3 * at;
    float *shN = arrays[5] + r->rest_count * at, logit = (float)values[OPACITY];
    double squared = 0.0, length;
    int is_finite = !isnan(logit);
    for (unsigned i = 0; i < 3; i++) {
        position[i] = values[X + i];
        means[i] = (float)values[X + i];
        scales[i] = (float)values[SCALE + i];
        scales[i] = scales[i] == -HUGE_VALF ? -88.0f : scales[i]; /* the logarithm of 0 */
        sh0[i] = (float)values[DC + i];
        is_finite &= isfinite(means[i]) && isfinite(scales[i]) && isfinite(sh0[i]);
    }
    for (unsigned i = 0; i < 4; i++) {
        quats[i] = (float)values[QUAT + i];
        is_finite &= isfinite(quats[i]) != 0;
    }
    for (unsigned i = 0; i < r->rest_count; i++) {
        float value = (float)values[REST + i];
        shN[3 * (i % coefficients) + i / coefficients] = value;
        is_finite &= isfinite(value) != 0;
    }
    if (!is_finite)
        return 0;
    arrays[3][at] = (float)(1.0 / (1.0 + csplat_exp(-(double)logit)));
    for (unsigned i = 0; i < 4; i++) {
        double square = (double)quats[i] * (double)quats[i];
        squared += square;
    }
    length = squared == 0.0 || fabs(squared - 1.0) <= 0x1p-22 ? 1.0 : sqrt(squared);
    for (unsigned i = 0; i < 4; i++)
        quats[i] = (float)(quats[i] / length);
    if (squared == 0.0)
        quats[0] = 1.0f;
    return 1;
}

static int compare_doubles(const void *a, const void *b)
{
    const double *x = a, *y = b;
    return (*x > *y) - (*x < *y);
}

/* Return the median of one column of [n][3], or of its distances from a centre. `sorted` is [n]. */
static double median_of(const double *positions, size_t n, const double *centre, double *sorted)
{
    for (size_t i = 0; i < n; i++)
        sorted[i] = centre ? fabs(positions[3 * i] - *centre) : positions[3 * i];
    qsort(sorted, n, sizeof *sorted, compare_doubles);
    double sum = sorted[(n - 1) / 2] + sorted[n / 2];
    return n % 2 ? sorted[n / 2] : sum / 2.0;
}

/* Choose an origin for positions [n][3] in doubles, so that floats lose nothing visible: 0 if they lose nothing at all or if the
 * scene is around 0, otherwise the scene's centre, rounded. `sorted` is [n]. */
static void choose_origin(const double *positions, size_t n, double *sorted, double origin[3])
{
    double spread = 0.0, farthest = 0.0, centre[3], step;
    int exponent, is_exact = 1;
    for (size_t i = 0; i < 3 * n; i++)
        is_exact &= (double)(float)positions[i] == positions[i];
    if (is_exact)
        return;
    for (unsigned axis = 0; axis < 3; axis++) {
        double distance;
        centre[axis] = median_of(positions + axis, n, NULL, sorted);
        distance = median_of(positions + axis, n, &centre[axis], sorted);
        spread = distance > spread ? distance : spread;
        farthest = fabs(centre[axis]) > farthest ? fabs(centre[axis]) : farthest;
    }
    if (farthest <= 16.0 * spread)
        return;
    frexp(spread, &exponent);
    step = ldexp(0.5, exponent);
    for (unsigned axis = 0; axis < 3; axis++)
        origin[axis] = spread > 0.0 ? rint(centre[axis] / step) * step : centre[axis];
}

/* Split positions in doubles into an origin and means (`split_origin` of codec/csplat/ply/comments.py). */
static void split_origin(reader *r, double *positions, float *means, double *sorted)
{
    csplat_splats *s = &r->out->splats;
    int is_exact = 1;
    if (!r->has_origin)
        choose_origin(positions, s->count, sorted, s->origin);
    for (size_t i = 0; i < 3 * (size_t)s->count; i++) {
        double back;
        if (r->has_origin && !r->adds_origin)
            positions[i] += s->origin[i % 3];
        means[i] = (float)(positions[i] - s->origin[i % 3]);
        back = (double)means[i] + s->origin[i % 3];
        is_exact &= back == positions[i];
    }
    s->positions = is_exact ? NULL : positions;
}

/* Read the rows of the splats; `text` is their element if the file is a text. */
static int read_splats(reader *r, uint64_t count, const element *text)
{
    csplat_splats *s = &r->out->splats;
    size_t widths[] = {3, 4, 3, 1, 3, r->rest_count}, n;
    uint64_t width = 14 + r->rest_count + (r->has_double ? 8 : 0); /* floats; three doubles, and one to sort */
    double values[COLUMNS + 1], unused[3], *positions = NULL;
    float *arrays[6];
    uint8_t *memory;
    TRY(text || check_rows(r, count));
    r->out->row_count = count;
    if (count > UINT32_MAX)
        return fail(r, CSPLAT_E_LIMIT, "E_LIMIT: more than %lu splats", (unsigned long)UINT32_MAX);
    n = (size_t)count;
    if (count * width > SIZE_MAX / 8)
        return fail(r, CSPLAT_E_LIMIT, "E_LIMIT: no memory for %lu splats", (unsigned long)count);
    memory = r->options.allocate(r->options.user, n * (size_t)width * sizeof(float) + 8);
    r->out->memory = memory;
    if (!memory)
        return fail(r, CSPLAT_E_LIMIT, "E_LIMIT: no memory for %lu splats", (unsigned long)count);
    if (r->has_double) {
        positions = (double *)(void *)memory;
        memory += 4 * n * sizeof *positions;
    }
    for (int i = 0; i < 6; i++) {
        arrays[i] = (float *)(void *)memory;
        memory += widths[i] * n * sizeof(float);
    }
    for (uint64_t row = 0; row < count; row++) {
        TRY(text ? read_text_row(r, text, values, row) : read_row(r, values, row));
        s->count += (uint32_t)convert_row(r, values, arrays, positions ? positions + 3 * (size_t)s->count : unused, s->count);
        if (r->options.progress && row % 65536 == 65535 && !r->options.progress(r->options.user, (double)row / (double)count))
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: the caller stopped the reading");
    }
    if (count && !s->count)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: all %lu rows contain NaN or infinity", (unsigned long)count);
    s->means = arrays[0], s->quats = arrays[1], s->scales = arrays[2];
    s->opacities = arrays[3], s->sh0 = arrays[4], s->shN = arrays[5];
    if (positions)
        split_origin(r, positions, arrays[0], positions + 3 * n);
    else if (r->adds_origin)
        memset(s->origin, 0, sizeof s->origin);
    return 1;
}

/* Read the format, the comments and the extent of the header; return where elements begin, and the number of lines before. */
static int read_header(reader *r, const uint8_t **elements, size_t *lines_before)
{
    word words[WORDS_MAX];
    unsigned count, total = 0;
    int has_form = 0;
    *lines_before = 0;
    for (*elements = NULL;;) {
        const uint8_t *line = r->at;
        TRY(next_line(r, words, &count));
        if (r->line == 1 && (count != 1 || !is_word(words[0], "ply")))
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: the file is no PLY");
        if (!count || r->line == 1)
            continue;
        if (is_word(words[0], "end_header"))
            break;
        if (is_word(words[0], "format") && count >= 2) {
            r->form = is_word(words[1], "ascii") ? TEXT : is_word(words[1], "binary_little_endian") ? LITTLE : BIG;
            has_form = r->form != BIG || is_word(words[1], "binary_big_endian");
        } else if (is_word(words[0], "comment") || is_word(words[0], "obj_info"))
            TRY(read_comment(r, words + 1, count - 1));
        else if (is_word(words[0], "element") || is_word(words[0], "property")) {
            element *last = &r->elements[r->element_count ? r->element_count - 1 : 0];
            *lines_before = *elements ? *lines_before : r->line - 1;
            *elements = *elements ? *elements : line;
            if (++total > PROPERTIES_MAX)
                return fail(r, CSPLAT_E_INPUT, "E_INPUT: the PLY header declares more than %u elements and properties",
                            (unsigned)PROPERTIES_MAX);
            if (is_word(words[0], "element")) {
                last = &r->elements[r->element_count++];
                if (count != 3 || !parse_count(words[2], &last->count))
                    return fail(r, CSPLAT_E_INPUT, "E_INPUT: the count of a PLY element is not a whole number");
            } else {
                last->width++;
                last->has_lists |= count > 1 && is_word(words[1], "list");
            }
        } else
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: line %lu of the PLY header has no known keyword", (unsigned long)r->line);
    }
    if (!has_form || !*elements)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: the PLY header has no known format, or no element");
    return 1;
}

/* Read elements up to that of the splats. Declarations are from `header` to `header_end`, where the rows begin; `lines_before` are
 * before the declarations. */
static int read_elements(reader *r, const uint8_t *header, const uint8_t *header_end, size_t lines_before)
{
    const uint8_t *rows_at = header_end, *rows_end = r->end;
    size_t text_line = r->line + 1, header_line = lines_before;
    word words[WORDS_MAX];
    element *current = NULL;
    int is_splats = 0, has_layout = r->form != TEXT;
    for (;;) {
        unsigned count;
        r->at = header;
        r->end = header_end;
        r->line = header_line;
        TRY(next_line(r, words, &count));
        header = r->at;
        header_line = r->line;
        int is_end = count && is_word(words[0], "end_header"), is_element = count && is_word(words[0], "element");
        if (count && is_word(words[0], "property"))
            TRY(read_property(r, words, count, is_splats));
        if (!is_end && !is_element)
            continue;
        r->at = rows_at;
        r->end = rows_end;
        r->line = text_line;
        TRY(!is_splats || check_columns(r));
        if (current && !has_layout)
            TRY(find_layout(r));
        has_layout |= current != NULL;
        if (is_splats)
            return read_splats(r, current->count, r->form == TEXT ? current : NULL);
        if (current && r->form == TEXT)
            skip_text(r, current);
        else if (current)
            TRY(skip_rows(r, current->count));
        if (is_end)
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: the PLY has no element vertex: not a PLY of splats");
        rows_at = r->at;
        text_line = r->line;
        is_splats = is_word(words[1], "vertex");
        current = current ? current + 1 : r->elements;
        r->property_count = 0;
    }
}

csplat_code csplat_read_ply(const void *data, size_t size, const csplat_encode_options *options, csplat_ply *out,
                            csplat_error *error)
{
    csplat_error own;
    const uint8_t *elements;
    size_t lines_before;
    reader *r;
    memset(out, 0, sizeof *out);
    error = error ? error : &own;
    memset(error, 0, sizeof *error);
    error->offset = CSPLAT_NO_OFFSET;
    error->clause = "";
    r = options && options->allocate ? options->allocate(options->user, sizeof *r) : malloc(sizeof *r);
    if (!r) {
        error->code = CSPLAT_E_LIMIT;
        return error->code;
    }
    memset(r, 0, sizeof *r);
    if (options)
        r->options = *options;
    if (!r->options.allocate) {
        r->options.allocate = plain_allocate;
        r->options.release = plain_release;
    }
    r->error = error;
    r->out = out;
    r->at = data;
    r->end = r->at + (size < HEADER_MAX ? size : HEADER_MAX);
    if (read_header(r, &elements, &lines_before)) {
        const uint8_t *header_end = r->at;
        r->end = (const uint8_t *)data + size;
        read_elements(r, elements, header_end, lines_before);
    }
    if (error->code) {
        r->options.release(r->options.user, out->memory);
        memset(out, 0, sizeof *out);
    }
    r->options.release(r->options.user, r);
    return error->code;
}
