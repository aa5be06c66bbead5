/* SPDX-License-Identifier: Apache-2.0 */
/* cc csplat.c example.c -lz -lm && ./a.out scene.csplat: print the contents of a file, tile by tile. */
#include "csplat.h"

#include <stdio.h>
#include <stdlib.h>

static int failed(const csplat_error *error)
{
    fprintf(stderr, "%s\n", error->message);
    return 1;
}

static int read_part(void *file, uint64_t offset, size_t size, void *into)
{
    return fseek(file, (long)offset, SEEK_SET) == 0 && fread(into, 1, size, file) == size;
}

int main(int count, char **arguments)
{
    FILE *input = count == 2 ? fopen(arguments[1], "rb") : NULL;
    csplat_source source = {read_part, input, 0};
    csplat_error error;
    csplat *file;
    if (!input || fseek(input, 0, SEEK_END)) {
        fprintf(stderr, "usage: %s scene.csplat\n", arguments[0]);
        return 2;
    }
    source.size = (uint64_t)ftell(input);
    if (csplat_open(&file, &source, NULL, &error))
        return failed(&error);

    const csplat_info *info = csplat_get_info(file);
    printf("%llu splats, SH degree %u, %lu tile%s, axes %s\n", (unsigned long long)info->splat_count, info->sh_degree,
           (unsigned long)info->tile_count, info->tile_count == 1 ? "" : "s", info->axes[0] ? info->axes : "unknown");
    if (info->coarse_tile_count)
        printf("coarser levels: %lu tile%s\n", (unsigned long)info->coarse_tile_count,
               info->coarse_tile_count == 1 ? "" : "s");
    const char *metadata;
    size_t size;
    if (csplat_read_text(file, CSPLAT_METADATA, &metadata, &size))
        return failed(csplat_last_error(file));
    if (metadata)
        printf("%s\n", metadata);

    float *means = malloc(3 * sizeof(float) * CSPLAT_TILE_SPLATS), *opacities = malloc(sizeof(float) * CSPLAT_TILE_SPLATS);
    if (!means || !opacities)
        return 1;
    for (uint32_t i = 0; i < info->tile_count; i++) {
        csplat_tile tile;
        csplat_floats out = {.means = means, .opacities = opacities};
        double opacity = 0;
        if (csplat_get_tile(file, i, &tile) || csplat_read_tile(file, i, 0, &out))
            return failed(csplat_last_error(file));
        for (uint32_t k = 0; k < tile.splat_count; k++)
            opacity += opacities[k];
        printf("tile %lu: %lu splats, the first at (%g, %g, %g), mean opacity %.3f\n", (unsigned long)i,
               (unsigned long)tile.splat_count, means[0], means[1], means[2], opacity / tile.splat_count);
    }
    free(means);
    free(opacities);
    csplat_close(file);
    fclose(input);
    return 0;
}
