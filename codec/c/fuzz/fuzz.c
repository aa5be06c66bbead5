/* SPDX-License-Identifier: Apache-2.0 */
/* Coverage-guided fuzzing of the decoder, by libFuzzer:
 *
 *     make fuzz-c
 *
 * Most mutants have their checksums repaired, and the offsets of all chunks if a chunk has changed its length, so that damage
 * gets past the container. If csplat_decode accepts a file, all other ways of reading must accept it too. Tiles above level 0,
 * whose payloads csplat_decode leaves unread, must be accepted by all of them or by none. */
#include "../csplat.c"

size_t LLVMFuzzerMutate(uint8_t *data, size_t size, size_t max_size);
size_t LLVMFuzzerCustomMutator(uint8_t *data, size_t size, size_t max_size, unsigned seed);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

enum { CHUNKS_MAX = 4096 };

/* Code of the mutator does not count as coverage of the decoder. */
#define UNCOVERED __attribute__((no_sanitize("coverage")))

/* A record that names a chunk: positions of its fields in the file. */
typedef struct entry {
    size_t size_at, offset_at, crc_at;
    uint32_t size;
    uint64_t offset;
} entry;

static void put_u32(uint8_t *p, uint32_t x)
{
    for (int i = 0; i < 4; i++)
        p[i] = (uint8_t)(x >> 8 * i);
}

static void put_u64(uint8_t *p, uint64_t x)
{
    put_u32(p, (uint32_t)x);
    put_u32(p + 4, (uint32_t)(x >> 32));
}

static uint32_t checksum(const uint8_t *p, size_t size)
{
    static csplat tables;
    if (!tables.crc_table[0][1])
        make_crc_table(tables.crc_table);
    return crc32_of(&tables, p, size);
}

/* Find the records that name chunks, as far as the index is complete. */
UNCOVERED static size_t find_entries(const uint8_t *data, size_t size, entry *out)
{
    const uint8_t *head = data + SPEC_HEADER_SIZE;
    size_t at = SPEC_HEADER_SIZE, count = 0, end;
    if (size < SPEC_HEADER_SIZE + SPEC_INDEX_HEAD_SIZE || head[5] < SPEC_TILE_RECORD_SIZE)
        return 0;
    end = SPEC_HEADER_SIZE + get_u32(data + SPEC_HEADER_AT_INDEX_SIZE);
    end = end < size ? end : size;
    at += head[0] + (size_t)head[SPEC_INDEX_HEAD_AT_ATTRIBUTE_COUNT] * head[1] +
          (size_t)get_u16(head + SPEC_INDEX_HEAD_AT_CODEBOOK_COUNT) * head[2] +
          (size_t)get_u16(head + SPEC_INDEX_HEAD_AT_EXTRA_COUNT) * head[3];
    for (unsigned i = get_u16(head + SPEC_INDEX_HEAD_AT_DIRECTORY_COUNT); i; i--, at += head[4]) {
        if (at + SPEC_DIRECTORY_RECORD_SIZE > end || count == CHUNKS_MAX)
            return count;
        out[count].size_at = at + SPEC_DIRECTORY_RECORD_AT_SIZE;
        out[count].offset_at = at + SPEC_DIRECTORY_RECORD_AT_OFFSET;
        out[count++].crc_at = at + SPEC_DIRECTORY_RECORD_AT_CRC;
    }
    for (uint32_t i = get_u32(head + SPEC_INDEX_HEAD_AT_TILE_COUNT); i; i--) {
        unsigned layers, tables;
        if (at + SPEC_TILE_RECORD_SIZE > end)
            return count;
        layers = data[at + SPEC_TILE_RECORD_AT_LAYER_COUNT];
        tables = get_u16(data + at + SPEC_TILE_RECORD_AT_TABLE_COUNT);
        at += head[5];
        for (; layers; layers--, at += head[6]) {
            if (at + SPEC_LAYER_RECORD_SIZE > end || count == CHUNKS_MAX)
                return count;
            out[count].size_at = at + SPEC_LAYER_RECORD_AT_SIZE;
            out[count].offset_at = at + SPEC_LAYER_RECORD_AT_OFFSET;
            out[count++].crc_at = at + SPEC_LAYER_RECORD_AT_CRC;
        }
        at += 2 * (size_t)tables;
    }
    return count;
}

UNCOVERED static size_t read_entries(const uint8_t *data, size_t size, entry *out)
{
    size_t count = find_entries(data, size, out);
    for (size_t i = 0; i < count; i++) {
        out[i].size = get_u32(data + out[i].size_at);
        out[i].offset = get_u64(data + out[i].offset_at);
    }
    return count;
}

UNCOVERED static int is_inside(const entry *e, size_t size)
{
    return e->offset <= size && e->size <= size - e->offset && e->size >= SPEC_CHUNK_HEADER_SIZE;
}

UNCOVERED static void repair(uint8_t *data, size_t size)
{
    static entry entries[CHUNKS_MAX];
    size_t count = read_entries(data, size, entries), index_size;
    if (size < SPEC_HEADER_SIZE)
        return;
    for (size_t i = 0; i < count; i++)
        if (is_inside(&entries[i], size))
            put_u32(data + entries[i].crc_at, checksum(data + entries[i].offset, entries[i].size));
    index_size = get_u32(data + SPEC_HEADER_AT_INDEX_SIZE);
    if (index_size >= 4 && index_size <= size - SPEC_HEADER_SIZE) {
        size_t at = SPEC_HEADER_SIZE + index_size - 4;
        put_u32(data + at, checksum(data + SPEC_HEADER_SIZE, index_size - 4));
    }
    put_u32(data + SPEC_HEADER_AT_HEADER_CRC, checksum(data, SPEC_HEADER_AT_HEADER_CRC));
}

/* Replace the payload of a chunk and update the offsets of all chunks after it. */
UNCOVERED static size_t change_chunk(uint8_t *data, size_t size, size_t max_size, unsigned seed)
{
    static entry entries[CHUNKS_MAX];
    size_t count = read_entries(data, size, entries), room = max_size - size, start, end, grown;
    uint8_t *payload;
    entry *e;
    if (!count)
        return LLVMFuzzerMutate(data, size, max_size);
    e = &entries[seed % count];
    if (!is_inside(e, size) || e->size == SPEC_CHUNK_HEADER_SIZE)
        return LLVMFuzzerMutate(data, size, max_size);
    start = (size_t)e->offset + SPEC_CHUNK_HEADER_SIZE;
    end = (size_t)e->offset + e->size;
    payload = malloc(end - start + room);
    if (!payload)
        return size;
    memcpy(payload, data + start, end - start);
    grown = LLVMFuzzerMutate(payload, end - start, end - start + (seed & 0x10000 ? room : 0));
    memmove(data + start + grown, data + end, size - end);
    memcpy(data + start, payload, grown);
    free(payload);
    size = size - (end - start) + grown;
    for (size_t i = 0; i < count; i++)
        if (entries[i].offset >= end)
            put_u64(data + entries[i].offset_at, entries[i].offset - (end - start) + grown);
    put_u32(data + e->size_at, (uint32_t)(grown + SPEC_CHUNK_HEADER_SIZE));
    put_u32(data + e->offset + SPEC_CHUNK_HEADER_AT_PAYLOAD_SIZE, (uint32_t)grown);
    put_u64(data + SPEC_HEADER_AT_FILE_SIZE, size);
    return size;
}

UNCOVERED size_t LLVMFuzzerCustomMutator(uint8_t *data, size_t size, size_t max_size, unsigned seed)
{
    unsigned kind = (seed >> 20) % 16;
    if (kind < 11)
        size = change_chunk(data, size, max_size, seed);
    else if (kind < 15 && size > SPEC_HEADER_SIZE) { /* mutate header and index in place */
        size_t index_size = get_u32(data + SPEC_HEADER_AT_INDEX_SIZE), end = SPEC_HEADER_SIZE + index_size;
        end = end < size ? end : size;
        LLVMFuzzerMutate(data + SPEC_HEADER_SIZE, end - SPEC_HEADER_SIZE, end - SPEC_HEADER_SIZE);
    } else
        size = LLVMFuzzerMutate(data, size, max_size);
    if (seed % 64)
        repair(data, size);
    return size;
}

static int read_bytes(void *user, uint64_t offset, size_t size, void *into)
{
    memcpy(into, (const uint8_t *)user + offset, size);
    return 1;
}

/* Return the worst of the nodes that are in a cut and have children, or the number of nodes. */
static uint32_t worst_of(const csplat_node *nodes, uint32_t count, const uint8_t *in_cut)
{
    uint32_t worst = count;
    for (uint32_t i = 0; i < count; i++)
        if (in_cut[i] && nodes[i].level > 0 && (worst == count || nodes[i].error >= nodes[worst].error))
            worst = i;
    return worst;
}

/* Mark the nodes of cut_within, step by step as the specification does; return 0 if there is no such cut. */
static int cut_within(const csplat_node *nodes, uint32_t count, uint64_t budget, uint8_t *in_cut)
{
    uint64_t splats = 0;
    for (uint32_t i = 0; i < count; i++)
        if ((in_cut[i] = nodes[i].parent == CSPLAT_NO_PARENT))
            splats += nodes[i].splat_count;
    if (splats > budget)
        return 0;
    for (uint32_t worst; (worst = worst_of(nodes, count, in_cut)) < count;) {
        splats -= nodes[worst].splat_count;
        for (uint32_t i = 0; i < count; i++)
            splats += nodes[i].parent == worst ? nodes[i].splat_count : 0;
        if (splats > budget)
            break;
        for (uint32_t i = 0; i < count; i++)
            in_cut[i] |= nodes[i].parent == worst;
        in_cut[worst] = 0;
    }
    return 1;
}

/* Compare a cut within a budget with that of the slow function. */
static void check_budget_cut(csplat *file, const csplat_node *nodes, uint32_t node_count, uint64_t budget)
{
    const csplat_info *info = csplat_get_info(file);
    const csplat_cut cut = {CSPLAT_CUT_SPLATS, 0, 0, NULL, budget, NULL};
    uint32_t *tiles = malloc(((size_t)info->tile_count + info->coarse_tile_count) * sizeof *tiles), count, at = 0;
    uint8_t *in_cut = malloc(node_count);
    csplat_code code;
    if (!tiles || !in_cut)
        abort();
    code = csplat_select(file, &cut, tiles, &count);
    if (cut_within(nodes, node_count, budget, in_cut) != (code == CSPLAT_OK) || (code && code != CSPLAT_E_LIMIT))
        abort();
    for (uint32_t i = 0; !code && i < node_count; i++)
        for (uint32_t k = 0; in_cut[i] && k < nodes[i].tile_count; k++)
            if (at == count || tiles[at++] != nodes[i].first_tile + k)
                abort();
    if (!code && at != count)
        abort();
    free(tiles);
    free(in_cut);
}

/* Select at a pixel size, everywhere and in the region of the last node. */
static void check_pixel_cut(csplat *file, const csplat_node *nodes, uint32_t node_count, double pixel_size)
{
    const csplat_info *info = csplat_get_info(file);
    double box[] = {-FLT_MAX, -FLT_MAX, -FLT_MAX, FLT_MAX, FLT_MAX, FLT_MAX};
    csplat_cut cut = {CSPLAT_CUT_PIXEL_SIZE, 0, 0, NULL, 0, box};
    uint32_t *tiles = malloc(((size_t)info->tile_count + info->coarse_tile_count) * sizeof *tiles), count, again;
    double *sizes = malloc(node_count * sizeof *sizes);
    uint64_t splats = 0;
    if (!tiles || !sizes)
        abort();
    for (uint32_t i = 0; i < node_count; i++)
        sizes[i] = pixel_size;
    cut.pixel_sizes = sizes;
    cut.pixel_size_count = node_count;
    if (csplat_select(file, &cut, tiles, &count))
        abort();
    for (uint32_t i = 0; i < count; i++) {
        csplat_tile tile;
        if (csplat_get_tile(file, tiles[i], &tile) || (i && tiles[i] <= tiles[i - 1]))
            abort();
        splats += tile.splat_count;
    }
    if (splats > info->splat_count || count == 0)
        abort();
    for (unsigned i = 0; i < 3; i++) {
        box[i] = nodes[node_count - 1].min[i];
        box[3 + i] = nodes[node_count - 1].max[i];
    }
    if (csplat_select(file, &cut, tiles, &again) || again == 0 || again > count)
        abort();
    free(tiles);
    free(sizes);
}

/* Read nodes and cuts; return whether the nodes were accepted. */
static int read_cuts(csplat *file)
{
    const csplat_node *nodes;
    uint32_t count;
    if (csplat_read_nodes(file, &nodes, &count))
        return 0;
    for (uint32_t i = 0; i < count && i < 50; i++) {
        check_budget_cut(file, nodes, count, nodes[i].splat_count);
        check_budget_cut(file, nodes, count, csplat_get_info(file)->splat_count - nodes[i].splat_count % 8);
        check_pixel_cut(file, nodes, count, nodes[i].error);
    }
    return 1;
}

/* Read a tile by every other way than csplat_decode; return whether all of it was accepted. */
static int read_tile_otherwise(csplat *file, uint32_t i)
{
    const csplat_info *info = csplat_get_info(file);
    csplat_integers integers = {0};
    csplat_packed_geometry geometry;
    csplat_packed packed;
    csplat_columns table;
    csplat_tile tile;
    csplat_floats floats = {0};
    int32_t exponents[ATTRIBUTES_END - OPACITIES];
    float *band;
    int accepted = 1, whole;
    csplat_get_tile(file, i, &tile);
    integers.means = malloc(tile.splat_count * 3 * sizeof(int64_t));
    integers.quats = malloc(tile.splat_count * 3 * sizeof(int32_t));
    integers.sh[0] = malloc(tile.splat_count * 9 * sizeof(int64_t));
    integers.exponents = exponents;
    band = malloc(tile.splat_count * COLUMNS_MAX * sizeof(float));
    if (!integers.means || !integers.quats || !integers.sh[0] || !band)
        abort();
    for (unsigned k = 1; k <= info->sh_degree; k++) { /* in either order, since a band may need the indices of a lower one */
        const unsigned l = (info->file_size + i) % 2 ? k : info->sh_degree + 1 - k;
        accepted &= csplat_read_packed_band(file, i, l, &packed) == CSPLAT_OK;
        if (packed.index)
            accepted &= csplat_read_packed_codebook(file, packed.codebook, l, &table) == CSPLAT_OK;
        accepted &= csplat_read_band(file, i, l, band) == CSPLAT_OK;
    }
    accepted &= csplat_read_packed(file, i, &geometry) == CSPLAT_OK;
    floats.means = band;
    whole = csplat_read_tile(file, i, info->sh_degree, &floats) == CSPLAT_OK;
    if (whole != (csplat_read_integers(file, i, &integers) == CSPLAT_OK) || whole != accepted)
        abort();
    if (tile.level == 0)
        accepted &= csplat_read_extras(file, i, NULL) == CSPLAT_OK;
    free(integers.means);
    free(integers.quats);
    free(integers.sh[0]);
    free(band);
    return accepted;
}

/* Read by every other way than csplat_decode; return whether all that it reads was accepted. */
static int read_otherwise(csplat *file)
{
    const csplat_info *info = csplat_get_info(file);
    int accepted = csplat_check(file) == CSPLAT_OK, found;
    csplat_declared_errors errors;
    const char *text;
    size_t length;
    for (int which = 0; which < 3; which++)
        accepted &= csplat_read_text(file, (csplat_text)which, &text, &length) == CSPLAT_OK;
    accepted &= csplat_read_declared_errors(file, &errors, &found) == CSPLAT_OK;
    accepted &= read_cuts(file);
    for (uint32_t i = 0; i < info->tile_count; i++)
        accepted &= read_tile_otherwise(file, i);
    for (uint32_t i = 0; i < info->coarse_tile_count; i++)
        read_tile_otherwise(file, info->tile_count + i);
    return accepted;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const csplat_options small = {5000, 8000000, 100000, 0, NULL, NULL, NULL, NULL};
    csplat_source source = {read_bytes, NULL, 0};
    csplat *file, *other;
    csplat_scene *scene;
    csplat_error error;
    int accepted;
    source.user = (void *)(uintptr_t)data;
    source.size = size;
    if (csplat_open_memory(&file, data, size, &small, &error))
        return 0;
    accepted = csplat_decode(file, CSPLAT_SH_DEGREE_MAX, &scene) == CSPLAT_OK;
    csplat_free_scene(file, scene);
    if (csplat_open(&other, &source, &small, NULL))
        abort();
    /* The other ways of reading do not check the budgets of csplat_decode. */
    if (csplat_last_error(file)->code != CSPLAT_E_LIMIT && accepted != read_otherwise(other))
        abort();
    csplat_close(file);
    csplat_close(other);
    return 0;
}
