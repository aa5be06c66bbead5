/* SPDX-License-Identifier: Apache-2.0 */
/* csplat FILE THREADS: prints "ready", then decodes once for each input line and prints seconds and bytes of arrays.
 * Each thread opens the file, and they share its tiles. */
#include "csplat.h"

#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static void *data;
static size_t size;
static csplat_floats values;
static atomic_uint next;

static void check(csplat_code code, const csplat_error *error)
{
    if (code) {
        fprintf(stderr, "%s\n", error->message);
        exit(1);
    }
}

static csplat *opened(void)
{
    csplat *file;
    csplat_error error;
    check(csplat_open_memory(&file, data, size, NULL, &error), &error);
    return file;
}

static void *share(void *unused)
{
    csplat *file = opened();
    const csplat_info *info = csplat_get_info(file);
    size_t rest = ((info->sh_degree + 1) * (info->sh_degree + 1) - 1) * 3;
    for (uint32_t i; (i = atomic_fetch_add(&next, 1)) <= info->tile_count;) {
        csplat_tile tile;
        if (i == info->tile_count) { /* the last share: parts of the file that no tile needs */
            check(csplat_check(file), csplat_last_error(file));
            break;
        }
        check(csplat_get_tile(file, i, &tile), csplat_last_error(file));
        csplat_floats out = {values.means + 3 * tile.first,     values.quats + 4 * tile.first,
                             values.scales + 3 * tile.first,    values.opacities + tile.first,
                             values.sh0 + 3 * tile.first,       rest ? values.shN + rest * tile.first : NULL};
        check(csplat_read_tile(file, i, info->sh_degree, &out), csplat_last_error(file));
    }
    csplat_close(file);
    return unused;
}

static void decode_in_threads(int threads, size_t splats, size_t floats)
{
    pthread_t others[64];
    float *all = malloc(splats * floats * sizeof *all);
    values = (csplat_floats){all, all + 3 * splats, all + 7 * splats, all + 10 * splats, all + 11 * splats, all + 14 * splats};
    next = 0;
    for (int i = 1; i < threads; i++)
        pthread_create(&others[i], NULL, share, NULL);
    share(NULL);
    for (int i = 1; i < threads; i++)
        pthread_join(others[i], NULL);
    free(all);
}

static double now(void)
{
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

int main(int count, char **arguments)
{
    FILE *input = count == 3 ? fopen(arguments[1], "rb") : NULL;
    int threads = input ? atoi(arguments[2]) : 0, letter;
    if (threads < 1 || threads > 64)
        return 2;
    fseek(input, 0, SEEK_END);
    size = (size_t)ftell(input);
    rewind(input);
    data = malloc(size);
    if (fread(data, 1, size, input) != size)
        return 1;
    puts("ready");
    fflush(stdout);
    while ((letter = getchar()) != EOF) {
        if (letter != '\n')
            continue;
        double began = now();
        csplat *file = opened();
        const csplat_info *info = csplat_get_info(file);
        size_t floats = 11 + 3 * (size_t)((info->sh_degree + 1) * (info->sh_degree + 1));
        csplat_scene *scene = NULL;
        if (threads == 1)
            check(csplat_decode(file, info->sh_degree, &scene), csplat_last_error(file));
        else
            decode_in_threads(threads, info->splat_count, floats);
        printf("%.9f %zu\n", now() - began, (size_t)info->splat_count * floats * sizeof(float));
        fflush(stdout);
        if (scene)
            csplat_free_scene(file, scene);
        csplat_close(file);
    }
    return 0;
}
