/* SPDX-License-Identifier: Apache-2.0 */
/* The interface of the C decoder for JavaScript (../wasm_decoder.mjs). An instance decodes one file, which it reads with the
 * import `read`. It has no messages: JavaScript decodes refused files again to report the error. */
#include "../../c/csplat.c"

#define EXPORT(name) __attribute__((export_name(#name))) js_##name

__attribute__((import_module("env"), import_name("read"))) int read_part(double offset, size_t size, void *into);

enum { SH_ROWS = 512 }; /* as in ../wasm_decoder.mjs */

/* ../wasm_decoder.mjs reads these structures directly from memory. */
typedef char columns_as_expected[sizeof(csplat_columns) == 240 && offsetof(csplat_columns, offset) == 16 ? 1 : -1];
typedef char packed_as_expected[sizeof(csplat_packed) == 256 && offsetof(csplat_packed, rows) == 240 ? 1 : -1];

static csplat *file;
static csplat_packed_geometry geometry;
static csplat_packed band_columns;
static csplat_columns entries;
static buffer values;
static block bands[SPEC_SH_DEGREE_MAX + 1];
static size_t rows_put[SPEC_SH_DEGREE_MAX + 1];

/* Replaces the library's snprintf, which would be larger than the decoder. */
int snprintf(char *out, size_t size, const char *format, ...)
{
    (void)format;
    if (size)
        *out = 0;
    return 0;
}

int vsnprintf(char *out, size_t size, const char *format, va_list arguments)
{
    (void)format, (void)arguments;
    if (size)
        *out = 0;
    return 0;
}

static int read_from_javascript(void *user, uint64_t offset, size_t size, void *into)
{
    (void)user;
    return read_part((double)offset, size, into);
}

int EXPORT(open)(double size)
{
    csplat_source source = {read_from_javascript, NULL, (uint64_t)size};
    return csplat_open(&file, &source, NULL, NULL) == CSPLAT_OK;
}

void EXPORT(close)(void)
{
    release(file, values.data);
    memset(&values, 0, sizeof values);
    csplat_close(file);
}

int EXPORT(check)(void)
{
    return csplat_check(file) == CSPLAT_OK;
}

/* A tile's means, quats, scales, opacities and sh0, one after the other; NULL if the tile or an SH band is refused. */
const float *EXPORT(read_tile)(uint32_t index, unsigned degree)
{
    const tile *t;
    csplat_floats out = {0};
    if (!find_tile(file, index, &t) || !reserve(file, &values, t->splat_count, 14 * sizeof(float)))
        return NULL;
    out.means = values.data;
    out.quats = out.means + 3 * (size_t)t->splat_count;
    out.scales = out.quats + 4 * (size_t)t->splat_count;
    out.opacities = out.scales + 3 * (size_t)t->splat_count;
    out.sh0 = out.opacities + t->splat_count;
    memset(rows_put, 0, sizeof rows_put);
    return read_tile_blocks(file, t, degree, &out, bands) ? values.data : NULL;
}

/* SH of the tile's splats `from` to `to`. Called in order, with few splats at a time so that they stay in the L1 cache. */
const float *EXPORT(read_rows)(unsigned degree, uint32_t from, uint32_t to)
{
    static float rows[SH_ROWS * 3 * ((SPEC_SH_DEGREE_MAX + 1) * (SPEC_SH_DEGREE_MAX + 1) - 1)];
    put_bands(bands, 1, degree, from, to, rows_put, rows, 3 * (size_t)coefficients_of(degree));
    return rows;
}

const float *EXPORT(read_band)(uint32_t index, unsigned band)
{
    const tile *t;
    if (!find_tile(file, index, &t) || !reserve(file, &values, t->splat_count, 3 * (2 * (size_t)band + 1) * sizeof(float)))
        return NULL;
    return csplat_read_band(file, index, band, values.data) ? NULL : values.data;
}

const csplat_packed_geometry *EXPORT(read_packed)(uint32_t index)
{
    return csplat_read_packed(file, index, &geometry) ? NULL : &geometry;
}

const csplat_packed *EXPORT(read_packed_band)(uint32_t index, unsigned band)
{
    return csplat_read_packed_band(file, index, band, &band_columns) ? NULL : &band_columns;
}

const csplat_columns *EXPORT(read_packed_codebook)(unsigned id, unsigned band)
{
    return csplat_read_packed_codebook(file, (uint16_t)id, band, &entries) ? NULL : &entries;
}
