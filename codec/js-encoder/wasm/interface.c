/* SPDX-License-Identifier: Apache-2.0 */
/* The interface of the C encoder for JavaScript (../encoder.mjs). An instance reads one PLY or encodes one scene, or both. */
#include "../../c/csplat_encode.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT(name) __attribute__((export_name(#name))) js_##name
#define IMPORT(name) __attribute__((import_module("env"), import_name(#name)))

IMPORT(progress) int js_progress(double done);

/* The fields of a scene, which both sides write, as doubles; ../encoder.mjs has the same list. */
enum { COUNT, DEGREE, MEANS, QUATS, SCALES, OPACITIES, SH0, SHN, POSITIONS, ORIGIN, UNIT = ORIGIN + 3, AXES, ANTIALIASED = AXES + 3,
       FLAT, COLOUR_SPACE, METADATA, METADATA_SIZE, ROW_COUNT, FILE_SIZE, CODE, FIELDS };

static double fields[FIELDS];
static csplat_error error;

/* Replaces the library's, which would be larger than the encoder; the encoder formats only %s, %u and %lu. */
int vsnprintf(char *out, size_t size, const char *format, va_list arguments)
{
    size_t at = 0;
    for (; *format; format++) {
        char digits[24];
        const char *text = digits + sizeof digits - 1;
        if (*format != '%') {
            if (at + 1 < size)
                out[at++] = *format;
            continue;
        }
        format += format[1] == 'l' ? 2 : 1;
        if (*format == 's')
            text = va_arg(arguments, const char *);
        else {
            unsigned long value = va_arg(arguments, unsigned long);
            char *digit = digits + sizeof digits - 1;
            *digit = 0;
            do
                *--digit = (char)('0' + value % 10);
            while (value /= 10);
            text = digit;
        }
        while (*text && at + 1 < size)
            out[at++] = *text++;
    }
    if (size)
        out[at] = 0;
    return (int)at;
}

int snprintf(char *out, size_t size, const char *format, ...)
{
    va_list arguments;
    int result;
    va_start(arguments, format);
    result = vsnprintf(out, size, format, arguments);
    va_end(arguments);
    return result;
}

static int report(void *user, double done)
{
    (void)user;
    return js_progress(done);
}

double *EXPORT(fields)(void)
{
    return fields;
}

const char *EXPORT(message)(void)
{
    return error.message;
}

void *EXPORT(allocate)(size_t size)
{
    return malloc(size);
}

void EXPORT(release)(void *memory)
{
    free(memory);
}

/* Read a PLY, which is released; the arrays stay in memory. */
int EXPORT(read_ply)(uint8_t *data, size_t size)
{
    csplat_encode_options options = {.progress = report};
    csplat_ply ply;
    csplat_code code = csplat_read_ply(data, size, &options, &ply, &error);
    const csplat_splats *s = &ply.splats;
    free(data);
    fields[CODE] = code;
    fields[COUNT] = s->count;
    fields[DEGREE] = s->sh_degree;
    fields[MEANS] = (double)(uintptr_t)s->means;
    fields[QUATS] = (double)(uintptr_t)s->quats;
    fields[SCALES] = (double)(uintptr_t)s->scales;
    fields[OPACITIES] = (double)(uintptr_t)s->opacities;
    fields[SH0] = (double)(uintptr_t)s->sh0;
    fields[SHN] = (double)(uintptr_t)s->shN;
    fields[POSITIONS] = (double)(uintptr_t)s->positions;
    fields[UNIT] = s->unit_metres;
    for (int i = 0; i < 3; i++) {
        fields[ORIGIN + i] = s->origin[i];
        fields[AXES + i] = s->axes[i];
    }
    fields[ANTIALIASED] = s->antialiased;
    fields[FLAT] = s->flat;
    fields[COLOUR_SPACE] = s->colour_space;
    fields[METADATA_SIZE] = 0;
    fields[ROW_COUNT] = (double)ply.row_count;
    return code == CSPLAT_OK;
}

/* Encode the scene of the fields; `source_index` may be NULL. NULL on failure. */
uint8_t *EXPORT(encode)(uint32_t *source_index)
{
    csplat_encode_options options = {.source_index = source_index, .progress = report};
    csplat_splats s = {0};
    uint8_t *file;
    size_t size;
    s.count = (uint32_t)fields[COUNT];
    s.sh_degree = (unsigned)fields[DEGREE];
    s.means = (const float *)(uintptr_t)fields[MEANS];
    s.quats = (const float *)(uintptr_t)fields[QUATS];
    s.scales = (const float *)(uintptr_t)fields[SCALES];
    s.opacities = (const float *)(uintptr_t)fields[OPACITIES];
    s.sh0 = (const float *)(uintptr_t)fields[SH0];
    s.shN = (const float *)(uintptr_t)fields[SHN];
    s.positions = (const double *)(uintptr_t)fields[POSITIONS];
    s.unit_metres = fields[UNIT];
    for (int i = 0; i < 3; i++) {
        s.origin[i] = fields[ORIGIN + i];
        s.axes[i] = (char)fields[AXES + i];
    }
    s.antialiased = (uint8_t)fields[ANTIALIASED];
    s.flat = (uint8_t)fields[FLAT];
    s.colour_space = (uint8_t)fields[COLOUR_SPACE];
    s.metadata = (const char *)(uintptr_t)fields[METADATA];
    s.metadata_size = (size_t)fields[METADATA_SIZE];
    fields[CODE] = csplat_encode(&s, &options, &file, &size, &error);
    fields[FILE_SIZE] = (double)size;
    return file;
}
