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

typedef struct reader {
    const uint8_t *at, *end;
    encoding form;
    csplat_error *error;
    csplat_encode_options options;
    csplat_ply *out;
    property properties[PROPERTIES_MAX]; /* of the current element */
    unsigned property_count, rest_count;
    size_t line; /* number of the header line */
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

/* Copy a word for messages and for strtod, cut to WORD_MAX - 1 characters. */
static const char *text_of(word w, char buffer[WORD_MAX])
{
    size_t size = w.size < WORD_MAX - 1 ? w.size : WORD_MAX - 1;
    for (size_t i = 0; i < size; i++)
        buffer[i] = w.at[i] >= ' ' && w.at[i] <= '~' ? w.at[i] : '?';
    buffer[size] = 0;
    return buffer;
}

/* Parse a number that is the whole word. */
static int parse_number(word w, double *value)
{
    char buffer[WORD_MAX], *end;
    if (w.size >= WORD_MAX)
        return 0;
    *value = strtod(text_of(w, buffer), &end);
    return w.size && *end == 0;
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
            if (count != 5 || !parse_number(words[2 + i], &numbers[i]) || !(fabs(numbers[i]) <= DBL_MAX))
                return bad_comment(r, key);
        memcpy(s->origin, numbers, sizeof numbers);
        r->has_origin = 1;
        r->adds_origin = is_word(key, "absolute_origin");
    } else if (is_word(key, "unit_metres")) {
        if (count != 3 || !parse_number(words[2], &s->unit_metres) || !(s->unit_metres > 0.0 && s->unit_metres <= DBL_MAX))
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

/* Return the next word of a text, empty at its end. */
static word next_word(reader *r)
{
    word w;
    while (r->at < r->end && is_space(*r->at))
        r->at++;
    w.at = (const char *)r->at;
    while (r->at < r->end && !is_space(*r->at))
        r->at++;
    w.size = (size_t)((const char *)r->at - w.at);
    return w;
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

/* Read the next row of an element, and the values of its columns; `row` is its number, for messages. */
static int read_row(reader *r, double *values, uint64_t row)
{
    for (unsigned i = 0; i < r->property_count; i++) {
        const property *p = &r->properties[i];
        uint64_t count = 1;
        double number = 0.0;
        char text[WORD_MAX];
        if (p->count_kind != NO_TYPE && r->form == TEXT) {
            if (!parse_count(next_word(r), &count))
                return fail(r, CSPLAT_E_INPUT, "E_INPUT: row %lu has an invalid list", (unsigned long)row);
        } else if (p->count_kind != NO_TYPE) {
            size_t size = size_of(p->count_kind);
            if ((size_t)(r->end - r->at) < size)
                return fail(r, CSPLAT_E_INPUT, "E_INPUT: the file is cut off in row %lu", (unsigned long)row);
            count = load(r, r->at, size);
            r->at += size;
        }
        if (r->form != TEXT) {
            size_t size = size_of(p->kind);
            if ((size_t)(r->end - r->at) / size < count)
                return fail(r, CSPLAT_E_INPUT, "E_INPUT: the file is cut off in row %lu", (unsigned long)row);
            if (p->column >= 0)
                number = convert(load(r, r->at, size), p->kind);
            r->at += count * size;
        }
        for (; r->form == TEXT && count; count--) {
            word w = next_word(r);
            if (!w.size)
                return fail(r, CSPLAT_E_INPUT, "E_INPUT: the file is cut off in row %lu", (unsigned long)row);
            if (!parse_number(w, &number))
                return fail(r, CSPLAT_E_INPUT, "E_INPUT: row %lu contains '%s', expected a number", (unsigned long)row,
                            text_of(w, text));
        }
        if (p->column >= 0)
            values[p->column] = p->kind == DOUBLE ? number : (double)(float)number;
    }
    return 1;
}

/* Return the least number of bytes of a row. */
static uint64_t least_row(const reader *r)
{
    uint64_t size = 0;
    for (unsigned i = 0; i < r->property_count; i++) {
        const property *p = &r->properties[i];
        size += r->form == TEXT ? 2 : p->count_kind == NO_TYPE ? size_of(p->kind) : size_of(p->count_kind);
    }
    return size;
}

/* Check that an element can have that many rows. */
static int check_rows(reader *r, uint64_t count)
{
    uint64_t size = least_row(r), left = (uint64_t)(r->end - r->at) + (r->form == TEXT);
    if (size ? count > left / size : count > UINT32_MAX)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: the file is cut off: it has no room for its rows");
    return 1;
}

static int skip_rows(reader *r, uint64_t count)
{
    double unused[COLUMNS + 1];
    int has_list = r->form == TEXT;
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

/* Read the rows of the splats. */
static int read_splats(reader *r, uint64_t count)
{
    csplat_splats *s = &r->out->splats;
    size_t widths[] = {3, 4, 3, 1, 3, r->rest_count}, n;
    uint64_t width = 14 + r->rest_count + (r->has_double ? 8 : 0); /* floats; three doubles, and one to sort */
    double values[COLUMNS + 1], unused[3], *positions = NULL;
    float *arrays[6];
    uint8_t *memory;
    TRY(check_rows(r, count));
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
        TRY(read_row(r, values, row));
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

/* Read the format, the comments and the extent of the header; return where elements begin. */
static int read_header(reader *r, const uint8_t **elements)
{
    word words[WORDS_MAX];
    unsigned count, total = 0;
    int has_form = 0;
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
            *elements = *elements ? *elements : line;
            if (++total > PROPERTIES_MAX)
                return fail(r, CSPLAT_E_INPUT, "E_INPUT: the PLY header declares more than %u elements and properties",
                            (unsigned)PROPERTIES_MAX);
        } else
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: line %lu of the PLY header has no known keyword", (unsigned long)r->line);
    }
    if (!has_form || !*elements)
        return fail(r, CSPLAT_E_INPUT, "E_INPUT: the PLY header has no known format, or no element");
    return 1;
}

/* Read elements up to that of the splats. Declarations are from `header` to `header_end`, where the rows begin. */
static int read_elements(reader *r, const uint8_t *header, const uint8_t *header_end)
{
    const uint8_t *rows_at = header_end, *rows_end = r->end;
    word words[WORDS_MAX];
    uint64_t rows = 0;
    int is_splats = 0, has_element = 0;
    for (;;) {
        unsigned count;
        r->at = header;
        r->end = header_end;
        TRY(next_line(r, words, &count));
        header = r->at;
        int is_end = count && is_word(words[0], "end_header"), is_element = count && is_word(words[0], "element");
        if (count && is_word(words[0], "property"))
            TRY(read_property(r, words, count, is_splats));
        if (!is_end && !is_element)
            continue;
        r->at = rows_at;
        r->end = rows_end;
        if (is_splats)
            return check_columns(r) && read_splats(r, rows);
        if (has_element)
            TRY(skip_rows(r, rows));
        if (is_end)
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: the PLY has no element vertex: not a PLY of splats");
        rows_at = r->at;
        if (count != 3 || !parse_count(words[2], &rows))
            return fail(r, CSPLAT_E_INPUT, "E_INPUT: the count of a PLY element is not a whole number");
        is_splats = is_word(words[1], "vertex");
        has_element = 1;
        r->property_count = 0;
    }
}

csplat_code csplat_read_ply(const void *data, size_t size, const csplat_encode_options *options, csplat_ply *out,
                            csplat_error *error)
{
    csplat_error own;
    const uint8_t *elements;
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
    if (read_header(r, &elements)) {
        const uint8_t *header_end = r->at;
        r->end = (const uint8_t *)data + size;
        read_elements(r, elements, header_end);
    }
    if (error->code) {
        r->options.release(r->options.user, out->memory);
        memset(out, 0, sizeof *out);
    }
    r->options.release(r->options.user, r);
    return error->code;
}
