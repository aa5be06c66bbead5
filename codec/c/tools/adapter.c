/* SPDX-License-Identifier: Apache-2.0 */
/* Adapts the C decoder to the protocol of the conformance suite (conformance/IMPLEMENTERS.md):
 *
 *     csplat conformance decoder --cmd 'csplat_adapter {input} {outdir}'
 *
 * `csplat_adapter --cuts {input} {cuts}` prints the tiles of each cut. Without arguments it reads input and folder from standard
 * input, alternating line by line, and answers each pair with a line of JSON, which is {} if the file was decoded. Tests then
 * need not start a process for each file. Three numbers are budgets: splats, bytes, bytes of a text.
 *
 * The file is decoded as a whole and tile by tile; from memory and through a callback; to floats, integers and packed
 * arrays. If two of these disagree, the adapter exits with status 2. */
#include "csplat.h"

#include <ctype.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const char *directory;
static csplat_options options;
static unsigned char *data;
static size_t size;

static void die(const char *what)
{
    fprintf(stderr, "%s\n", what);
    exit(2);
}

static void *room(size_t count, size_t each)
{
    void *memory = calloc(count ? count : 1, each);
    if (!memory)
        die("no memory");
    return memory;
}

/* Read a file, followed by a NUL. */
static unsigned char *load(const char *path, size_t *count)
{
    FILE *input = fopen(path, "rb");
    unsigned char *bytes;
    if (!input)
        die("cannot open");
    fseek(input, 0, SEEK_END);
    *count = (size_t)ftell(input);
    rewind(input);
    bytes = room(*count + 1, 1);
    if (fread(bytes, 1, *count, input) != *count)
        die("cannot read");
    fclose(input);
    return bytes;
}

static void refuse(const csplat_error *error)
{
    printf("{\"code\": \"%s\", \"clause\": \"%s\"", csplat_code_name(error->code), error->clause);
    if (error->offset != CSPLAT_NO_OFFSET)
        printf(", \"offset\": %llu", (unsigned long long)error->offset);
    printf("}\n");
}

static FILE *create(const char *part, const char *name)
{
    char path[4096];
    size_t at = (size_t)snprintf(path, sizeof path - 256, "%s/%s", directory, part);
    FILE *file;
    for (; *name && at < sizeof path - 8; name++)
        if (isalnum((unsigned char)*name) || strchr("-._~", *name))
            path[at++] = *name;
        else
            at += (size_t)snprintf(path + at, 4, "%%%02X", (unsigned char)*name);
    strcpy(path + at, strcmp(part, "header") == 0 ? ".json" : ".bin");
    if (!(file = fopen(path, "wb")))
        die("cannot write");
    return file;
}

static void put(const char *part, const char *name, const void *values, size_t bytes)
{
    FILE *file = create(part, name);
    if (bytes && fwrite(values, 1, bytes, file) != bytes)
        die("cannot write");
    fclose(file);
}

/* Return the number of tiles of all levels. */
static uint32_t tiles_of(const csplat_info *info)
{
    return info->tile_count + info->coarse_tile_count;
}

/* Write a text as a JSON string; it has no control characters. */
static void put_string(FILE *file, const char *text)
{
    fputc('"', file);
    for (; *text; text++) {
        if (*text == '"' || *text == '\\')
            fputc('\\', file);
        fputc(*text, file);
    }
    fputc('"', file);
}

static void put_header(const csplat_info *info)
{
    FILE *file = create("header", "");
    fprintf(file, "{\"profile\": \"base\", \"resource_level\": \"%c\", ", info->resource_level);
    fprintf(file, "\"splat_count\": %llu, \"tile_count\": %lu, \"sh_degree\": %u, ",
            (unsigned long long)info->splat_count, (unsigned long)tiles_of(info), info->sh_degree);
    fprintf(file, "\"scene_flags\": [%s], \"kernel\": \"ellipse\", ", info->flat ? "\"flat\"" : "");
    fprintf(file, "\"projection\": %u, \"antialiasing\": %u, \"colour_space\": %u, ", info->projection, info->antialiasing,
            info->colour_space);
    fprintf(file, "\"extra_columns\": [");
    for (uint32_t i = 0, known = 0; i < info->extra_count; i++)
        if (info->extras[i].bytes) {
            fprintf(file, known++ ? ", [" : "[");
            put_string(file, info->extras[i].name);
            fprintf(file, ", ");
            put_string(file, info->extras[i].semantic);
            fputc(']', file);
        }
    fprintf(file, "], ");
    if (info->antialiased != (info->antialiasing == 1))
        die("antialiased differs from antialiasing");
    fprintf(file, "\"axes\": \"%s\", \"unit_metres\": %.17g, \"origin\": [%.17g, %.17g, %.17g]}\n", info->axes,
            info->unit_metres, info->origin[0], info->origin[1], info->origin[2]);
    fclose(file);
}

static int from_memory(void *user, uint64_t offset, size_t count, void *into)
{
    (void)user;
    if (offset > size || count > size - offset)
        return 0;
    memcpy(into, data + offset, count);
    return 1;
}

static int64_t element_of(const csplat_columns *c, size_t row, unsigned column)
{
    const size_t at = (size_t)column * c->count + row;
    return c->offset[column] + (int64_t)(c->width == 1   ? ((const uint8_t *)c->data)[at]
                                         : c->width == 2 ? ((const uint16_t *)c->data)[at]
                                                         : ((const uint32_t *)c->data)[at]);
}

/* Return an integer of a packed attribute of splat i of a tile; `table` is its codebook, if any. */
static int64_t packed_integer(const csplat_packed *p, const csplat_columns *table, size_t i, unsigned column, size_t *row)
{
    const csplat_columns *from = &p->columns;
    size_t at = i;
    if (p->index) {
        at = p->index_width == 1   ? ((const uint8_t *)p->index)[i]
             : p->index_width == 2 ? ((const uint16_t *)p->index)[i]
                                   : ((const uint32_t *)p->index)[i];
        from = table;
    }
    if (p->rows) {
        int mine = *row < p->columns.count && p->rows[*row] == i;
        if (!mine && !p->index)
            return 0;
        if (mine) {
            at = *row;
            from = &p->columns;
        }
    } else if (!p->index && p->columns.count == 0)
        return 0;
    return element_of(from, at, column);
}

/* Check packed values against the integers [n][columns], colours of `coefficients`. */
static void compare(const csplat_packed *p, const csplat_columns *table, size_t n, unsigned columns, unsigned coefficients,
                    const int64_t *integers)
{
    size_t row = 0;
    for (size_t i = 0; i < n; i++) {
        for (unsigned k = 0; k < columns; k++)
            if (packed_integer(p, table, i, k, &row) != integers[i * columns + k % coefficients * 3 + k / coefficients])
                die("the packed form differs from the integers");
        row += p->rows && row < p->columns.count && p->rows[row] == i;
    }
}

/* Check a packed attribute of layer 0 against the integers [n][columns], which are not colours. */
static void compare_levels(const csplat_packed *p, size_t n, unsigned columns, const uint32_t *integers)
{
    size_t row = 0;
    for (size_t i = 0; i < columns * n; i++)
        if (packed_integer(p, NULL, i / columns, (unsigned)(i % columns), &row) != (int32_t)integers[i])
            die("packed levels differ from the integers");
}

static void compare_packed(csplat *file, uint32_t tile, size_t n, unsigned degree, const csplat_integers *integers)
{
    csplat_packed_geometry g;
    if (csplat_read_packed(file, tile, &g))
        die("the packed form is refused");
    compare_levels(&g.opacities, n, 1, integers->opacities);
    compare_levels(&g.quats, n, 3, (const uint32_t *)integers->quats);
    compare(&g.scales, NULL, n, 3, 1, integers->scales);
    compare(&g.means, NULL, n, 3, 1, integers->means);
    compare(&g.sh0, NULL, n, 3, 1, integers->sh0);
    for (unsigned band = 1; band <= degree; band++) {
        csplat_packed p;
        csplat_columns table = {0};
        if (csplat_read_packed_band(file, tile, band, &p))
            die("a packed band is refused");
        if (p.index && csplat_read_packed_codebook(file, p.codebook, band, &table))
            die("a packed codebook is refused");
        for (unsigned k = 0; k < table.columns; k++) /* a row of zeros follows the entries */
            if (element_of(&table, table.count - 1, k))
                die("a packed codebook does not end with zeros");
        compare(&p, &table, n, 3 * (2 * band + 1), 2 * band + 1, integers->sh[band - 1]);
    }
}

/* Check a tile that is read alone, through a callback, against its values in the whole scene, if that contains it. */
static void compare_floats(csplat *file, uint32_t tile, const csplat_tile *t, const csplat_scene *scene)
{
    const size_t n = t->splat_count, k = ((size_t)scene->sh_degree + 1) * (scene->sh_degree + 1) - 1, first = (size_t)t->first;
    float *means = room(n, 12), *shN = room(n, 12 * (k ? k : 1)), *band = room(n, 12 * (2 * CSPLAT_SH_DEGREE_MAX + 1));
    csplat_floats out = {0};
    out.means = means;
    out.shN = shN;
    if (csplat_read_tile(file, tile, scene->sh_degree, &out))
        die("a tile is refused");
    if (t->level == 0 && (memcmp(means, scene->values.means + 3 * first, 12 * n) ||
                          memcmp(shN, scene->values.shN + 3 * k * first, 12 * k * n)))
        die("a tile differs from the whole");
    for (unsigned axis = 0; axis < 3; axis++) { /* [TIL-10]: some splats lie on each side of the box */
        float low = means[axis], high = low;
        for (size_t i = 1; i < n; i++) {
            low = means[3 * i + axis] < low ? means[3 * i + axis] : low;
            high = means[3 * i + axis] > high ? means[3 * i + axis] : high;
        }
        if (low != t->min[axis] || high != t->max[axis])
            die("the box of a tile is not that of its splats");
    }
    for (unsigned l = scene->sh_degree; l >= 1; l--) {
        if (csplat_read_band(file, tile, l, band))
            die("a band is refused");
        for (size_t i = 0; i < n; i++)
            if (memcmp(band + i * 3 * (2 * l + 1), shN + 3 * (i * k + l * l - 1), 12 * (2 * (size_t)l + 1)))
                die("a band differs from the tile");
    }
    free(means);
    free(shN);
    free(band);
}

/* Check that nodes and cuts of level 0 are those of the tiles. */
static void check_nodes(csplat *file)
{
    const csplat_info *info = csplat_get_info(file);
    const csplat_cut cut = {CSPLAT_CUT_LEVEL, 0, 0, NULL, 0, NULL};
    uint32_t *tiles = room(tiles_of(info), 4), node_count, tile_count, sum = 0;
    const csplat_node *nodes;
    if (csplat_read_nodes(file, &nodes, &node_count) || csplat_select(file, &cut, tiles, &tile_count))
        die("the nodes are refused");
    for (uint32_t i = 0; i < node_count; i++)
        sum += nodes[i].tile_count;
    if (sum != tiles_of(info) || tile_count != info->tile_count)
        die("nodes or level 0 lack tiles");
    for (uint32_t i = 0; i < tile_count; i++)
        if (tiles[i] != i)
            die("level 0 is not the first tiles");
    free(tiles);
}

/* Write all arrays of a decoded file; return 1 if a tile above level 0 is refused. */
static int put_all(csplat *file, csplat *other, const csplat_scene *scene)
{
    csplat_integers all = {0};
    uint32_t *tile_splats, tile_count;
    const csplat_info *info;
    csplat_tile t = {0};
    size_t n, rows, records;
    int refused = 0;
    info = csplat_get_info(file);
    n = (size_t)info->splat_count;
    tile_count = tiles_of(info);
    if (tile_count)
        csplat_get_tile(file, tile_count - 1, &t);
    rows = (size_t)t.first + t.splat_count; /* splats of all levels */
    records = 5 + (size_t)info->sh_degree;
    tile_splats = room(tile_count, 4);
    all.opacities = room(rows, 4);
    all.scales = room(rows, 24);
    all.quats = room(rows, 12);
    all.means = room(rows, 24);
    all.sh0 = room(rows, 24);
    all.exponents = room(tile_count * records, 4);
    for (unsigned band = 1; band <= CSPLAT_SH_DEGREE_MAX; band++)
        all.sh[band - 1] = room(band <= info->sh_degree ? rows : 0, 24 * (2 * (size_t)band + 1));
    check_nodes(other);
    for (uint32_t i = 0; i < tile_count && !refused; i++) {
        csplat_integers part = all;
        size_t first;
        csplat_get_tile(file, i, &t);
        first = (size_t)t.first;
        tile_splats[i] = t.splat_count;
        part.opacities += first;
        part.scales += 3 * first;
        part.quats += 3 * first;
        part.means += 3 * first;
        part.sh0 += 3 * first;
        part.exponents += i * records;
        for (unsigned band = 1; band <= info->sh_degree; band++)
            part.sh[band - 1] += 3 * (2 * band + 1) * first;
        if (!csplat_read_integers(file, i, &part)) {
            compare_packed(other, i, t.splat_count, info->sh_degree, &part);
            compare_floats(other, i, &t, scene);
        } else if (t.level > 0) {
            refuse(csplat_last_error(file));
            refused = 1;
        } else
            die("integers are refused");
    }
    if (!refused) {
        put_header(info);
        put("integers.", "opacities", all.opacities, 4 * rows);
        put("integers.", "scales", all.scales, 24 * rows);
        put("integers.", "quats", all.quats, 12 * rows);
        put("integers.", "means", all.means, 24 * rows);
        put("integers.", "sh0", all.sh0, 24 * rows);
        for (unsigned band = 1; band <= info->sh_degree; band++) {
            const char name[] = {'s', 'h', (char)('0' + band), 0};
            put("integers.", name, all.sh[band - 1], 24 * (2 * (size_t)band + 1) * rows);
        }
        put("integers.", "tile_splats", tile_splats, 4 * (size_t)tile_count);
        put("integers.", "exponents", all.exponents, 4 * tile_count * records);
        put("floats.", "means", scene->values.means, 12 * n);
        put("floats.", "quats", scene->values.quats, 16 * n);
        put("floats.", "scales", scene->values.scales, 12 * n);
        put("floats.", "opacities", scene->values.opacities, 4 * n);
        put("floats.", "sh0", scene->values.sh0, 12 * n);
        put("floats.", "shN", scene->values.shN, 12 * n * (records - 5 + 1) * (records - 5 + 1) - 12 * n);
        for (uint32_t i = 0; i < info->extra_count; i++)
            if (scene->extras[i])
                put("extra.", info->extras[i].name, scene->extras[i], n * info->extras[i].bytes * info->extras[i].components);
    }
    free(all.opacities);
    free(all.scales);
    free(all.quats);
    free(all.means);
    free(all.sh0);
    free(all.exponents);
    for (int band = 0; band < CSPLAT_SH_DEGREE_MAX; band++)
        free(all.sh[band]);
    free(tile_splats);
    return refused;
}

/* Decode the file at a path; return 1 if it was refused. */
static int answer(const char *path)
{
    csplat_source source = {from_memory, NULL, 0};
    csplat *file, *other;
    csplat_scene *scene = NULL;
    csplat_error error;
    int refused = 1;
    data = load(path, &size);
    source.size = size;
    if (csplat_open_memory(&file, data, size, &options, &error))
        refuse(&error);
    else if (csplat_decode(file, CSPLAT_SH_DEGREE_MAX, &scene))
        refuse(csplat_last_error(file));
    else {
        if (csplat_open(&other, &source, &options, &error))
            die("through a callback it is refused");
        refused = put_all(file, other, scene);
        csplat_close(other);
    }
    if (file)
        csplat_free_scene(file, scene);
    csplat_close(file);
    free(data);
    return refused;
}

/* Parse the text of a cut, a word and its numbers, and perhaps `box` and six more; `sizes` has room for all of them. */
static csplat_cut read_cut(char *text, double *sizes, double box[6])
{
    csplat_cut cut = {CSPLAT_CUT_LEVEL, 0, 0, NULL, 0, NULL};
    char *corners = strstr(text, " box "), *word, *number;
    if (corners) {
        *corners = '\0';
        corners += strlen(" box ");
        for (int i = 0; i < 6; i++)
            box[i] = strtod(corners, &corners);
        cut.box = box;
    }
    word = strtok(text, " ");
    number = strtok(NULL, " ");
    if (!word || !number)
        die("a cut without a number");
    if (strcmp(word, "level") == 0)
        cut.level = (uint32_t)strtoul(number, NULL, 10);
    else if (strcmp(word, "splats") == 0) {
        cut.kind = CSPLAT_CUT_SPLATS;
        cut.splats = strtoull(number, NULL, 10);
    } else if (strcmp(word, "pixel_size") == 0) {
        cut.kind = CSPLAT_CUT_PIXEL_SIZE;
        cut.pixel_sizes = sizes;
        for (; number; number = strtok(NULL, " "))
            sizes[cut.pixel_size_count++] = strtod(number, NULL);
    } else
        die("a cut of another kind");
    return cut;
}

/* Print the tiles of each cut of a text; return 1 if the file was refused. */
static int answer_cuts(const char *path, const char *cuts)
{
    csplat *file = NULL;
    csplat_error error;
    const csplat_node *nodes;
    uint32_t *tiles, count;
    size_t length;
    char *text = (char *)load(cuts, &length);
    double *sizes = room(length, sizeof *sizes), box[6];
    int refused = 1;
    data = load(path, &size);
    if (csplat_open_memory(&file, data, size, &options, &error))
        refuse(&error);
    else if (csplat_read_nodes(file, &nodes, &count))
        refuse(csplat_last_error(file));
    else {
        tiles = room(tiles_of(csplat_get_info(file)), 4);
        for (char *line = text, *end; *line; line = end) {
            csplat_cut cut;
            csplat_code code;
            end = line + strcspn(line, "\n");
            if (*end)
                *end++ = '\0';
            cut = read_cut(line, sizes, box);
            code = csplat_select(file, &cut, tiles, &count);
            printf("%s", code ? csplat_code_name(code) : "");
            for (uint32_t i = 0; i < count; i++)
                printf("%s%lu", i ? " " : "", (unsigned long)tiles[i]);
            printf("\n");
        }
        free(tiles);
        refused = 0;
    }
    csplat_close(file);
    free(data);
    free(sizes);
    free(text);
    return refused;
}

int main(int count, char **arguments)
{
    static char path[4096], folder[4096];
    if (count == 3) {
        directory = arguments[2];
        return answer(arguments[1]);
    }
    if (count == 4 && strcmp(arguments[1], "--cuts") == 0)
        return answer_cuts(arguments[2], arguments[3]);
    if (count == 4) {
        options.splats_max = strtoull(arguments[1], NULL, 10);
        options.bytes_max = strtoull(arguments[2], NULL, 10);
        options.json_bytes_max = strtoull(arguments[3], NULL, 10);
    } else if (count != 1)
        die("usage: csplat_adapter [INPUT OUTDIR | --cuts INPUT CUTS | SPLATS BYTES JSON_BYTES]");
    directory = folder;
    while (fgets(path, sizeof path, stdin) && fgets(folder, sizeof folder, stdin)) {
        path[strcspn(path, "\n")] = folder[strcspn(folder, "\n")] = '\0';
        if (!answer(path))
            puts("{}");
        fflush(stdout);
    }
    return 0;
}
