/* SPDX-License-Identifier: Apache-2.0 */
/* Coverage-guided fuzzing of the PLY reader and the encoder, by libFuzzer (`make fuzz-c`): what the reader accepts, the encoder
 * encodes or refuses with a message, the same bytes in a second run; the decoder accepts every file.
 *
 * A header is prepended to most inputs, because mutations seldom leave one intact: the first byte is the SH degree, the second the
 * number of splats beyond those whose rows follow, which are copies. */
#include "../csplat_encode.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void require(int right)
{
    if (!right)
        abort();
}

/* Make a PLY of floats from rows and copies of them. */
static uint8_t *make_ply(const uint8_t *data, size_t size, size_t *made)
{
    unsigned degree = data[0] % 5, rest = 3 * ((degree + 1) * (degree + 1) - 1);
    size_t row = 4 * (14 + (size_t)rest), rows = (size - 2) / row, wanted = rows + (rows ? 4 * (size_t)data[1] : 0), at;
    char *ply = malloc(4096 + wanted * row);
    at = (size_t)sprintf(ply, "ply\nformat binary_little_endian 1.0\nelement vertex %lu\n", (unsigned long)wanted);
    for (unsigned i = 0; i < 14; i++) {
        static const char *const names[] = {"x",       "y",       "z",       "rot_0",   "rot_1",  "rot_2",  "rot_3",
                                            "scale_0", "scale_1", "scale_2", "opacity", "f_dc_0", "f_dc_1", "f_dc_2"};
        at += (size_t)sprintf(ply + at, "property float %s\n", names[i]);
    }
    for (unsigned i = 0; i < rest; i++)
        at += (size_t)sprintf(ply + at, "property float f_rest_%u\n", i);
    at += (size_t)sprintf(ply + at, "end_header\n");
    for (size_t i = 0; i < wanted; i++, at += row)
        memcpy(ply + at, data + 2 + i % rows * row, row);
    *made = at;
    return (uint8_t *)ply;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    csplat_error error;
    csplat_ply ply;
    csplat_scene *scene;
    csplat *decoder;
    uint8_t *input, *file, *again;
    size_t file_size, again_size;
    if (size < 2)
        return 0;
    if (data[0] == 'p') {
        input = malloc(size); /* exactly this size, so that the sanitizer detects reads beyond it */
        memcpy(input, data, size);
    } else
        input = make_ply(data, size, &size);
    if (csplat_read_ply(input, size, NULL, &ply, &error)) {
        require(error.message[0] && !ply.memory);
        free(input);
        return 0;
    }
    free(input);
    if (csplat_encode(&ply.splats, NULL, &file, &file_size, &error))
        require(error.message[0] && !file);
    else {
        require(csplat_encode(&ply.splats, NULL, &again, &again_size, &error) == CSPLAT_OK);
        require(again_size == file_size && memcmp(file, again, file_size) == 0);
        require(csplat_open_memory(&decoder, file, file_size, NULL, &error) == CSPLAT_OK);
        require(csplat_decode(decoder, CSPLAT_SH_DEGREE_MAX, &scene) == CSPLAT_OK);
        require(scene->splat_count == ply.splats.count);
        csplat_free_scene(decoder, scene);
        csplat_close(decoder);
        free(again);
        free(file);
    }
    free(ply.memory);
    return 0;
}
