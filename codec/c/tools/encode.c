/* SPDX-License-Identifier: Apache-2.0 */
/* cc csplat_encode.c csplat_ply.c deflate.c tools/encode.c -I. -lm && ./a.out scene.ply scene.csplat [index.npy]: encode a PLY.
 *
 * The status is 0, or 1 after one line on standard error; the file then does not exist. index.npy receives the number of the
 * source's splat that each splat of the file represents (conformance/IMPLEMENTERS.md). */
#include "csplat_encode.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int failed(const char *text)
{
    fprintf(stderr, "%s\n", text);
    return 1;
}

static int failed_at(const char *path)
{
    fprintf(stderr, "%s: %s\n", path, strerror(errno));
    return 1;
}

/* Read a file; NULL on failure. */
static uint8_t *read_file(const char *path, size_t *size)
{
    FILE *stream = fopen(path, "rb");
    uint8_t *data = NULL;
    long length;
    if (stream && fseek(stream, 0, SEEK_END) == 0 && (length = ftell(stream)) >= 0 && fseek(stream, 0, SEEK_SET) == 0) {
        *size = (size_t)length;
        data = malloc(*size + 1);
        if (data && fread(data, 1, *size, stream) != *size) {
            free(data);
            data = NULL;
        }
    }
    if (stream)
        fclose(stream);
    return data;
}

/* Write a file of two parts, whole or not at all. */
static int write_file(const char *path, const void *head, size_t head_size, const void *data, size_t size)
{
    char *part = malloc(strlen(path) + 6);
    FILE *stream;
    int right = 0;
    if (!part)
        return 0;
    strcat(strcpy(part, path), ".part");
    stream = fopen(part, "wb");
    if (stream) {
        right = fwrite(head, 1, head_size, stream) == head_size && fwrite(data, 1, size, stream) == size;
        right = fclose(stream) == 0 && right;
        right = right && rename(part, path) == 0;
        if (!right)
            remove(part);
    }
    free(part);
    return right;
}

/* Write integers [count] in the NPY format. */
static int write_index(const char *path, const uint32_t *index, uint32_t count)
{
    char head[129];
    int size = snprintf(head, sizeof head, "\x93NUMPY%c%cv%c{'descr': '<u4', 'fortran_order': False, 'shape': (%lu,), }", 1, 0, 0,
                        (unsigned long)count);
    uint8_t *bytes = malloc(4 * (size_t)count + 1);
    int right = bytes != NULL;
    memset(head + size, ' ', (size_t)(127 - size));
    head[7] = 0;
    head[8] = 118; /* bytes of the text */
    head[127] = '\n';
    for (uint32_t i = 0; i < count && right; i++)
        for (int k = 0; k < 4; k++)
            bytes[4 * (size_t)i + (size_t)k] = (uint8_t)(index[i] >> 8 * k);
    right = right && write_file(path, head, 128, bytes, 4 * (size_t)count);
    free(bytes);
    return right;
}

int main(int count, char **arguments)
{
    csplat_encode_options options = {0};
    csplat_error error;
    csplat_ply ply;
    size_t size, file_size;
    uint8_t *data, *file;
    int status = 0;
    if (count != 3 && count != 4) {
        fprintf(stderr, "usage: %s scene.ply scene.csplat [index.npy]\n", arguments[0]);
        return 2;
    }
    data = read_file(arguments[1], &size);
    if (!data)
        return failed_at(arguments[1]);
    if (csplat_read_ply(data, size, NULL, &ply, &error)) {
        free(data);
        return failed(error.message);
    }
    free(data);
    options.source_index = malloc(4 * (size_t)ply.splats.count + 1);
    if (!options.source_index || csplat_encode(&ply.splats, &options, &file, &file_size, &error))
        status = failed(options.source_index ? error.message : "E_LIMIT: no memory");
    else {
        if (!write_file(arguments[2], "", 0, file, file_size))
            status = failed_at(arguments[2]);
        else if (count == 4 && !write_index(arguments[3], options.source_index, ply.splats.count)) {
            status = failed_at(arguments[3]);
            remove(arguments[2]);
        }
        free(file);
    }
    free(options.source_index);
    free(ply.memory);
    return status;
}
