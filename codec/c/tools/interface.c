/* SPDX-License-Identifier: Apache-2.0 */
/* Tests beyond the conformance suite: failing callbacks, budgets, invalid arguments, a lower degree, boxes of cuts.
 *
 *     interface FILE...        status 0, or the line number of a failed check on standard error */
#include "csplat.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define HOLDS(what)                                                  \
    do {                                                             \
        if (!(what)) {                                               \
            fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #what); \
            exit(1);                                                 \
        }                                                            \
    } while (0)

/* Number of callback calls that succeed, and number of allocated blocks of memory. */
typedef struct caller {
    long allocations, reads, inflates, blocks;
    const unsigned char *data;
} caller;

static void *allocate(void *user, size_t size)
{
    caller *c = user;
    if (c->allocations-- <= 0)
        return NULL;
    c->blocks++;
    return malloc(size);
}

static void release(void *user, void *memory)
{
    ((caller *)user)->blocks -= memory != NULL;
    free(memory);
}

static int read_bytes(void *user, uint64_t offset, size_t size, void *into)
{
    caller *c = user;
    if (c->reads-- <= 0)
        return 0;
    memcpy(into, c->data + offset, size);
    return 1;
}

static int fail_to_inflate(void *user, const uint8_t *coded, size_t coded_size, uint8_t *out, size_t size)
{
    (void)coded, (void)coded_size, (void)out, (void)size;
    ((caller *)user)->inflates++;
    return 0;
}

/* Return the number of tiles of all levels. */
static uint32_t tiles_of(const csplat *d)
{
    return csplat_get_info(d)->tile_count + csplat_get_info(d)->coarse_tile_count;
}

/* Select all of level 0 by a budget. */
static csplat_code select_all(csplat *d)
{
    uint32_t *tiles = malloc((tiles_of(d) + 1) * sizeof *tiles), count;
    csplat_cut cut = {CSPLAT_CUT_SPLATS, 0, 0, NULL, UINT64_MAX, NULL};
    csplat_code code;
    HOLDS(tiles);
    code = csplat_select(d, &cut, tiles, &count);
    HOLDS(count == (code ? 0 : csplat_get_info(d)->tile_count));
    free(tiles);
    return code;
}

/* Open through callbacks, read everything, return the code. `d` is closed afterwards. */
static csplat_code read_all(caller *c, size_t size, const csplat_options *options)
{
    csplat_source source = {read_bytes, c, size};
    csplat_scene *scene;
    csplat_packed packed;
    csplat_packed_geometry geometry;
    csplat_columns columns;
    csplat_declared_errors errors;
    const csplat_node *nodes;
    csplat *d;
    const char *text;
    size_t length;
    uint32_t count;
    int found;
    csplat_code code = csplat_open(&d, &source, options, NULL);
    if (code)
        return code;
    code = csplat_decode(d, CSPLAT_SH_DEGREE_MAX, &scene);
    HOLDS((code == CSPLAT_OK) == (scene != NULL));
    csplat_free_scene(d, scene);
    for (int which = 0; which < 3 && !code; which++)
        code = csplat_read_text(d, (csplat_text)which, &text, &length);
    if (!code)
        code = csplat_read_declared_errors(d, &errors, &found);
    if (!code)
        code = csplat_read_nodes(d, &nodes, &count);
    if (!code)
        code = select_all(d);
    for (uint32_t i = 0; i < tiles_of(d) && !code; i++) {
        code = csplat_read_packed(d, i, &geometry);
        for (unsigned band = 1; band <= csplat_get_info(d)->sh_degree && !code; band++) {
            code = csplat_read_packed_band(d, i, band, &packed);
            if (!code && packed.index)
                code = csplat_read_packed_codebook(d, packed.codebook, band, &columns);
        }
    }
    HOLDS(!code || (csplat_last_error(d)->code == code && csplat_last_error(d)->message[0] == 'E'));
    csplat_close(d);
    return code;
}

static void functions_of_the_caller_may_fail(const unsigned char *data, size_t size)
{
    caller c = {0};
    csplat_options options = {0};
    csplat_code code = CSPLAT_E_LIMIT;
    options.user = &c;
    options.allocate = allocate;
    options.release = release;
    c.data = data;
    for (long k = 0; code; k++) { /* the first k allocations work */
        c.allocations = k;
        c.reads = 1000000;
        code = read_all(&c, size, &options);
        HOLDS(code == CSPLAT_OK || code == CSPLAT_E_LIMIT);
        HOLDS(c.blocks == 0);
    }
    code = CSPLAT_E_INPUT;
    for (long k = 0; code; k++) {
        c.allocations = 1000000;
        c.reads = k;
        code = read_all(&c, size, &options);
        HOLDS(code == CSPLAT_OK || code == CSPLAT_E_INPUT);
        HOLDS(c.blocks == 0);
    }
    c.reads = 1000000;
    options.inflate = fail_to_inflate;
    code = read_all(&c, size, &options);
    HOLDS(code == (c.inflates ? CSPLAT_E_CODER : CSPLAT_OK));
}

static void budgets_hold(const unsigned char *data, size_t size)
{
    csplat_options options = {0};
    csplat_scene *scene;
    csplat_declared_errors errors;
    const char *text;
    size_t length;
    csplat *d;
    int found;
    HOLDS(!csplat_open_memory(&d, data, size, NULL, NULL) && !csplat_decode(d, CSPLAT_SH_DEGREE_MAX, &scene));
    options.splats_max = scene->splat_count - 1;
    options.resource_level_max = (char)(csplat_get_info(d)->resource_level - 1);
    csplat_free_scene(d, scene);
    HOLDS(!csplat_check(d) && !csplat_read_text(d, CSPLAT_METADATA, &text, &length) && text && text[length] == '\0');
    HOLDS(!csplat_read_declared_errors(d, &errors, &found));
    csplat_close(d);
    HOLDS(csplat_open_memory(&d, data, size, &options, NULL) == CSPLAT_E_LIMIT && !d);
    options.resource_level_max++;
    HOLDS(!csplat_open_memory(&d, data, size, &options, NULL) && csplat_decode(d, CSPLAT_SH_DEGREE_MAX, &scene) == CSPLAT_E_LIMIT && !scene);
    csplat_close(d);
    options.splats_max = 0;
    options.bytes_max = 50;
    options.json_bytes_max = 8 * (uint64_t)length; /* none is left for its values */
    HOLDS(!csplat_open_memory(&d, data, size, &options, NULL) && csplat_decode(d, CSPLAT_SH_DEGREE_MAX, &scene) == CSPLAT_E_LIMIT);
    HOLDS(csplat_read_text(d, CSPLAT_METADATA, &text, &length) == CSPLAT_E_LIMIT && !text);
    HOLDS(csplat_get_info(d)->codebook_count == 0 || csplat_check(d) == CSPLAT_E_LIMIT);
    csplat_close(d);
}

static void arguments_are_checked(const unsigned char *data, size_t size)
{
    const csplat_floats none = {NULL, NULL, NULL, NULL, NULL, NULL};
    const csplat_integers nothing = {0};
    csplat_columns columns;
    csplat_packed packed;
    csplat_scene *scene;
    csplat_tile tile;
    const char *text;
    size_t length;
    csplat *d;
    HOLDS(!csplat_open_memory(&d, data, size, NULL, NULL));
    HOLDS(csplat_get_tile(d, tiles_of(d), &tile) == CSPLAT_E_INPUT);
    HOLDS(csplat_read_tile(d, 0, CSPLAT_SH_DEGREE_MAX + 1, &none) == CSPLAT_E_INPUT);
    HOLDS(csplat_read_tile(d, 0, CSPLAT_SH_DEGREE_MAX, &none) == CSPLAT_OK);
    HOLDS(csplat_read_integers(d, 0, &nothing) == CSPLAT_OK && csplat_read_extras(d, 0, NULL) == CSPLAT_OK);
    HOLDS(csplat_read_band(d, 0, 0, NULL) == CSPLAT_E_INPUT);
    HOLDS(csplat_read_band(d, 0, CSPLAT_SH_DEGREE_MAX + 1, NULL) == CSPLAT_E_INPUT);
    HOLDS(csplat_read_packed_band(d, 0, CSPLAT_SH_DEGREE_MAX + 1, &packed) == CSPLAT_E_INPUT);
    HOLDS(csplat_read_packed_codebook(d, 65535, 1, &columns) == CSPLAT_E_INPUT);
    HOLDS(csplat_read_text(d, (csplat_text)3, &text, &length) == CSPLAT_E_INPUT);
    for (unsigned degree = 0; degree < 2; degree++) {
        HOLDS(!csplat_decode(d, degree, &scene) && scene->sh_degree == degree);
        csplat_free_scene(d, scene);
    }
    csplat_close(d);
    HOLDS(csplat_open_memory(&d, NULL, 0, NULL, NULL) == CSPLAT_E_TRUNCATED && !d);
    csplat_close(NULL);
}

static csplat_code select_by(csplat *d, csplat_cut cut, uint32_t *tiles, uint32_t *count)
{
    csplat_code code = csplat_select(d, &cut, tiles, count);
    HOLDS(!code || *count == 0);
    return code;
}

static int has(const uint32_t *tiles, uint32_t count, uint32_t tile)
{
    for (uint32_t i = 0; i < count; i++)
        if (tiles[i] == tile)
            return 1;
    return 0;
}

static void cuts_are_checked(const unsigned char *data, size_t size)
{
    const csplat_cut level_0 = {CSPLAT_CUT_LEVEL, 0, 0, NULL, 0, NULL};
    double *sizes;
    double box[6];
    uint32_t *tiles, count, node_count;
    const csplat_node *nodes, *root, *again;
    const csplat_info *info;
    csplat_cut cut;
    csplat_tile tile;
    csplat *d;
    HOLDS(!csplat_open_memory(&d, data, size, NULL, NULL));
    info = csplat_get_info(d);
    HOLDS(!csplat_read_nodes(d, &nodes, &node_count) && !csplat_read_nodes(d, &again, &count));
    HOLDS(nodes == again && count == node_count && node_count > 0);
    root = &nodes[node_count - 1];
    HOLDS(root->parent == CSPLAT_NO_PARENT && (root->level > 0) == (info->coarse_tile_count > 0));
    tiles = malloc(tiles_of(d) * sizeof *tiles);
    sizes = malloc((node_count + 1) * sizeof *sizes);
    HOLDS(tiles && sizes);
    for (uint32_t i = 0; i <= node_count; i++)
        sizes[i] = HUGE_VAL;

    cut = level_0;
    HOLDS(!select_by(d, cut, tiles, &count) && count == info->tile_count && tiles[count - 1] == count - 1);
    cut.level = 256;
    HOLDS(select_by(d, cut, tiles, &count) == CSPLAT_E_INPUT);
    cut.level = 255;
    HOLDS(!select_by(d, cut, tiles, &count) && tiles[count - 1] == tiles_of(d) - 1);
    cut.kind = (csplat_cut_kind)3;
    HOLDS(select_by(d, cut, tiles, &count) == CSPLAT_E_INPUT);

    cut.kind = CSPLAT_CUT_PIXEL_SIZE;
    cut.pixel_sizes = sizes;
    HOLDS(select_by(d, cut, tiles, &count) == CSPLAT_E_INPUT);
    cut.pixel_size_count = node_count + 1;
    HOLDS(select_by(d, cut, tiles, &count) == CSPLAT_E_INPUT);
    cut.pixel_size_count = node_count;
    HOLDS(!select_by(d, cut, tiles, &count) && tiles[count - 1] == tiles_of(d) - 1);
    cut.pixel_size_count = 1;
    HOLDS(!select_by(d, cut, tiles, &count) && tiles[count - 1] == tiles_of(d) - 1);
    sizes[0] = -1e-300;
    HOLDS(select_by(d, cut, tiles, &count) == CSPLAT_E_INPUT);
    sizes[0] = NAN;
    HOLDS(select_by(d, cut, tiles, &count) == CSPLAT_E_INPUT);

    cut.kind = CSPLAT_CUT_SPLATS;
    cut.splats = 0;
    HOLDS(select_by(d, cut, tiles, &count) == CSPLAT_E_LIMIT && csplat_last_error(d)->offset == CSPLAT_NO_OFFSET);
    cut.splats = info->splat_count;
    HOLDS(!select_by(d, cut, tiles, &count) && count == info->tile_count);

    /* A corner of tile 0 touches its box. Of coarser levels, it touches the region of the node above tile 0. */
    HOLDS(!csplat_get_tile(d, 0, &tile) && tile.level == 0 && !csplat_get_tile(d, tiles_of(d) - 1, &tile));
    HOLDS((tile.first >= info->splat_count) == (tile.level > 0));
    HOLDS(!csplat_get_tile(d, 0, &tile));
    for (int i = 0; i < 3; i++)
        box[i] = box[3 + i] = tile.max[i];
    for (cut = level_0; cut.level < 256; cut.level++) {
        cut.box = box;
        HOLDS(!select_by(d, cut, tiles, &count) && count > 0 && (cut.level > 0 || tiles[0] == 0));
    }
    cut = level_0;
    cut.box = box;
    box[0] = box[3] = HUGE_VAL;
    HOLDS(!select_by(d, cut, tiles, &count) && count == 0);
    box[0] = -HUGE_VAL;
    HOLDS(!select_by(d, cut, tiles, &count) && count > 0);
    for (int i = 0; i < 6; i++) { /* the corners in another order; numbers between those of binary32 */
        box[i] = i < 3 ? HUGE_VAL : -HUGE_VAL;
        HOLDS(i < 5 || (!select_by(d, cut, tiles, &count) && count == info->tile_count));
    }
    for (uint32_t i = 0; i < info->tile_count; i++) {
        HOLDS(!csplat_get_tile(d, i, &tile));
        box[3] = tile.max[0];
        HOLDS(!select_by(d, cut, tiles, &count) && has(tiles, count, i));
        box[3] = nextafter(tile.max[0], HUGE_VAL);
        HOLDS(!select_by(d, cut, tiles, &count) && !has(tiles, count, i));
    }
    box[4] = NAN;
    HOLDS(select_by(d, cut, tiles, &count) == CSPLAT_E_INPUT);

    if (info->coarse_tile_count)
        HOLDS(csplat_read_extras(d, info->tile_count, NULL) == (info->extra_count ? CSPLAT_E_INPUT : CSPLAT_OK));
    free(tiles);
    free(sizes);
    csplat_close(d);
}

int main(int count, char **arguments)
{
    for (int i = 1; i < count; i++) {
        static unsigned char data[1 << 20];
        FILE *file = fopen(arguments[i], "rb");
        size_t size = file ? fread(data, 1, sizeof data, file) : 0;
        HOLDS(size && !fclose(file));
        functions_of_the_caller_may_fail(data, size);
        budgets_hold(data, size);
        arguments_are_checked(data, size);
        cuts_are_checked(data, size);
    }
    return 0;
}
