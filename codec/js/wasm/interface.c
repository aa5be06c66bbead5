/* What the JavaScript decoder (../compiled.mjs) calls of the decoder in C: one file to an instance, its bytes by the
 * import `read`. Messages are left out: what is refused here JavaScript decodes again, to say why.
 * SPDX-License-Identifier: Apache-2.0 */
#include "csplat.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

#define EXPORT(name) __attribute__((export_name(#name))) name

__attribute__((import_module("env"), import_name("read"))) int read_part(double offset, size_t size, void *into);

/* ../compiled.mjs reads these structures as they lie in memory. */
typedef char columns_as_expected[sizeof(csplat_columns) == 192 && offsetof(csplat_columns, offset) == 16 ? 1 : -1];
typedef char packed_as_expected[sizeof(csplat_packed) == 208 && offsetof(csplat_packed, rows) == 192 ? 1 : -1];

static csplat *file;
static csplat_packed_geometry geometry;
static csplat_packed band_columns;
static csplat_columns entries;
static float *values;
static size_t room;

/* In the place of the library's, which would take up more than the decoder. */
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

/* Room for n splats of so many floats. */
static float *reserve(size_t n, size_t floats)
{
    if (n * floats > room) {
        free(values);
        room = (values = malloc(n * floats * sizeof *values)) ? n * floats : 0;
    }
    return values;
}

int EXPORT(open)(double size)
{
    csplat_source source = {read_from_javascript, NULL, (uint64_t)size};
    return csplat_open(&file, &source, NULL, NULL) == CSPLAT_OK;
}

void EXPORT(close)(void)
{
    csplat_close(file);
    file = NULL;
}

int EXPORT(check)(void)
{
    return csplat_check(file) == CSPLAT_OK;
}

/* A tile's means, quats, scales, opacities, sh0 and shN, one after the other; NULL where it is refused. */
const float *EXPORT(read_tile)(uint32_t index, unsigned degree)
{
    csplat_tile tile;
    csplat_floats out;
    if (csplat_get_tile(file, index, &tile) ||
        !(out.means = reserve(tile.splat_count, 11 + 3 * ((size_t)degree + 1) * (degree + 1))))
        return NULL;
    out.quats = out.means + 3 * (size_t)tile.splat_count;
    out.scales = out.quats + 4 * (size_t)tile.splat_count;
    out.opacities = out.scales + 3 * (size_t)tile.splat_count;
    out.sh0 = out.opacities + tile.splat_count;
    out.shN = out.sh0 + 3 * (size_t)tile.splat_count;
    return csplat_read_tile(file, index, degree, &out) ? NULL : values;
}

const float *EXPORT(read_band)(uint32_t index, unsigned band)
{
    csplat_tile tile;
    if (csplat_get_tile(file, index, &tile) || !reserve(tile.splat_count, 3 * (2 * (size_t)band + 1)))
        return NULL;
    return csplat_read_band(file, index, band, values) ? NULL : values;
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
