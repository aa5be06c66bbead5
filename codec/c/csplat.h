/* SPDX-License-Identifier: Apache-2.0 */
/* A decoder for .csplat, a compressed format for 3D Gaussian splats (spec/format.md).
 *
 *     csplat *file;
 *     csplat_error error;
 *     if (csplat_open_memory(&file, data, size, NULL, &error)) return puts(error.message);
 *     const csplat_info *info = csplat_get_info(file);
 *     for (uint32_t i = 0; i < info->tile_count; i++) {
 *         csplat_floats out = {means, quats, scales, opacities, sh0, NULL};    CSPLAT_TILE_SPLATS rows each
 *         if (csplat_read_tile(file, i, 0, &out)) break;                      csplat_last_error(file) has the error
 *     }
 *     csplat_close(file);
 *
 * The tiles 0 to tile_count - 1 are the scene, level 0. A file with levels of detail has coarser versions of it in the tiles
 * that follow; csplat_select selects the tiles to draw.
 *
 * There is no global state. A csplat belongs to one thread at a time; threads can each open one on the same bytes.
 * Every function that can fail returns CSPLAT_OK, which is 0, or the code of the specification. After a failure the
 * csplat can still be used.
 *
 * Later versions add members at the end of structs and codes at the end of the list: set unused members to 0, and compile
 * again for another minor version. */
#ifndef CSPLAT_H
#define CSPLAT_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* begin generated: version and limits */
#define CSPLAT_VERSION "1.0.0" /* of this header; csplat_version returns that of the library */
#define CSPLAT_TILE_SPLATS 65536 /* maximum splats per tile */
#define CSPLAT_SH_DEGREE_MAX 4   /* maximum SH degree */
/* end generated */
#define CSPLAT_NO_OFFSET UINT64_MAX
#define CSPLAT_NO_PARENT UINT32_MAX

typedef struct csplat csplat;

/* Codes of the specification, section 12. */
typedef enum csplat_code {
    CSPLAT_OK = 0,
    /* begin generated: error codes */
    CSPLAT_E_MAGIC = 1, /* the file does not begin with the magic, or a text-mode transfer damaged it */
    CSPLAT_E_VERSION = 2, /* another version of the format */
    CSPLAT_E_TRUNCATED = 3, /* the data ends before what it announces */
    CSPLAT_E_TRAILING = 4, /* bytes follow the end of the file */
    CSPLAT_E_CRC = 5, /* a CRC-32 does not match */
    CSPLAT_E_RESERVED = 6, /* a reserved field or bit is not 0 */
    CSPLAT_E_VALUE = 7, /* a field holds a forbidden value */
    CSPLAT_E_INDEX = 8, /* index and chunks contradict each other */
    CSPLAT_E_UNSUPPORTED = 9, /* a profile, type or coding that this version or this decoder does not have */
    CSPLAT_E_STREAM = 10, /* a stream header contradicts its place */
    CSPLAT_E_CODER = 11, /* coded bytes are damaged, end early or late, or do not give the declared size */
    CSPLAT_E_RANGE = 12, /* a decoded integer or value is out of range */
    CSPLAT_E_CODEBOOK = 13, /* an index, a count or a codebook that does not fit */
    CSPLAT_E_BOX = 14, /* a tile's record does not describe its splats */
    CSPLAT_E_JSON = 15, /* a JSON chunk is not UTF-8 JSON of the right kind */
    CSPLAT_E_LIMIT = 16, /* a budget, of the decoder or of a cut, is too small */
    CSPLAT_E_INPUT = 17, /* the caller's data or arguments, not a file, are at fault */
    /* end generated */
} csplat_code;

typedef struct csplat_error {
    csplat_code code;
    uint64_t offset;       /* of the error, from the start of the file, or CSPLAT_NO_OFFSET */
    const char *clause;    /* clause of the specification, "CRC-1", or "" */
    char message[192];     /* one line: code, offset, clause, what is wrong */
} csplat_error;

/* The source of the bytes of a file. */
typedef struct csplat_source {
    /* Copy exactly `size` bytes at `offset` to `into`; return 0 on failure. */
    int (*read)(void *user, uint64_t offset, size_t size, void *into);
    void *user;
    uint64_t size; /* size of the file */
} csplat_source;

/* Every field may be 0, the default. */
typedef struct csplat_options {
    uint64_t splats_max;     /* limit of csplat_decode; default: none */
    uint64_t bytes_max;      /* limit of the arrays of csplat_decode and of codebooks; default: 8 GiB */
    uint64_t json_bytes_max; /* memory that a parsed text of csplat_read_text may take (STR-8); default: 128 MiB */
    char resource_level_max; /* highest resource level (specification, 8.1) of a file, 'A', 'B' or 'C'; default: 'C', all */
    /* Replace malloc and free. Set both or neither. */
    void *(*allocate)(void *user, size_t size);
    void (*release)(void *user, void *memory);
    /* Replaces zlib, or csplat_inflate if CSPLAT_NO_ZLIB is defined. Raw DEFLATE (RFC 1951): return 1 if `coded` is exactly
     * one complete stream of exactly `size` bytes. Section 6.2 of the specification lists the other requirements (COD-2 to
     * COD-8). */
    int (*inflate)(void *user, const uint8_t *coded, size_t coded_size, uint8_t *out, size_t size);
    void *user; /* passed to the three functions above */
} csplat_options;

typedef struct csplat_extra {
    const char *name; /* UTF-8, NUL-terminated */
    uint8_t dtype;    /* 1 u8, 2 i8, 3 u16, 4 i16, 5 u32, 6 i32, 7 f32, 8 f64; 0: unknown type or coding, never returned */
    uint8_t bytes;    /* per value; 0 if unknown */
    uint8_t components;   /* values of a splat, 1 to 64 */
    const char *semantic; /* what they mean, "label" or "feature:...": UTF-8, NUL-terminated; "" if that is not stated */
} csplat_extra;

typedef struct csplat_codebook {
    uint16_t id;
    uint8_t band_first, band_last; /* SH bands, or 0 if the codebook is not for SH colours */
    uint32_t size;                 /* number of entries */
} csplat_codebook;

/* The contents of header and index. */
typedef struct csplat_info {
    uint64_t file_size;
    char resource_level;        /* what a decoder must be able to hold at least (specification, 8.1): 'A', 'B' or 'C' */
    uint64_t splat_count;       /* of level 0 */
    uint32_t tile_count;        /* of level 0: tiles 0 to tile_count - 1 */
    uint32_t coarse_tile_count; /* of higher levels; their numbers follow */
    uint8_t sh_degree;
    uint8_t antialiased, flat; /* how to render: filter of Mip-Splatting, 2DGS */
    uint8_t projection, antialiasing, colour_space; /* numbers of the specification, 12, possibly unknown from 128 on */
    char axes[4];              /* directions of +x, +y, +z: letters of R L U D F B; "" if unknown */
    double unit_metres;        /* 0 if unknown */
    double origin[3];          /* the means are relative to it; it is not added */
    uint32_t opacity_levels;   /* M of the opacities; they are q / M, or (q / M)^2 if squared */
    uint8_t opacity_squared;
    uint32_t quat_levels;      /* M of the rotations */
    const csplat_codebook *codebooks;
    const csplat_extra *extras;
    uint32_t codebook_count, extra_count;
} csplat_info;

typedef struct csplat_tile {
    uint64_t first;       /* index of its first splat in the scene; tiles above level 0 continue from splat_count on */
    uint32_t splat_count;
    uint8_t level;        /* 0 is the scene, higher levels are coarser */
    uint8_t bands;        /* bit l - 1 is set if it has SH band l; otherwise its coefficients are 0 */
    float min[3], max[3]; /* bounding box of the centres */
    float max_scale;      /* natural logarithm of the largest standard deviation */
    uint32_t bytes[CSPLAT_SH_DEGREE_MAX + 1]; /* sizes of layer 0 and of the SH bands in the file */
} csplat_tile;

/* A node of the levels of detail (specification, 5.7): tiles that are drawn together, or else replaced by the node's children. */
typedef struct csplat_node {
    uint32_t parent; /* number of the parent, which is larger, or CSPLAT_NO_PARENT */
    uint32_t first_tile, tile_count;
    uint8_t level;
    uint64_t splat_count;
    float error;          /* pixel size, in scene units at the node, from which on it may replace the splats below it */
    float min[3], max[3]; /* region: bounding box of the centres of its splats and of those below it */
} csplat_node;

typedef enum csplat_cut_kind { CSPLAT_CUT_LEVEL, CSPLAT_CUT_PIXEL_SIZE, CSPLAT_CUT_SPLATS } csplat_cut_kind;

/* A version of the scene, of nodes of one or several levels. If every field is 0, it is level 0. */
typedef struct csplat_cut {
    csplat_cut_kind kind;
    uint32_t level;            /* LEVEL: the highest level to use, 0 to 255 */
    uint32_t pixel_size_count; /* PIXEL_SIZE: 1, or the number of nodes */
    const double *pixel_sizes; /* size of a pixel, scene units, at least 0: everywhere, or at each node */
    uint64_t splats;           /* SPLATS: maximum number of splats */
    const double *box;         /* [6], two corners in any order, relative to the origin; may be infinite. Select only
                                  what touches it. NULL: everything */
} csplat_cut;

/* Arrays for a tile's values; NULL to skip one. K = (degree + 1)^2 - 1, at most 24. */
typedef struct csplat_floats {
    float *means;     /* [n][3], scene units, relative to the origin */
    float *quats;     /* [n][4], w x y z, unit length */
    float *scales;    /* [n][3], natural logarithms of the standard deviations */
    float *opacities; /* [n], alpha */
    float *sh0;       /* [n][3], SH coefficient of band 0 */
    float *shN;       /* [n][K][3], bands 1 to degree */
} csplat_floats;

/* A whole scene. */
typedef struct csplat_scene {
    uint64_t splat_count;
    unsigned sh_degree; /* degree of shN */
    csplat_floats values;
    void **extras; /* [extra_count], [n][components] of each column's type; NULL for unknown types and codings */
} csplat_scene;

/* The integer arrays of the specification, 9.2, for tests; NULL to skip one. */
typedef struct csplat_integers {
    uint32_t *opacities;
    int64_t *scales, *means, *sh0, *sh[CSPLAT_SH_DEGREE_MAX]; /* sh[l - 1]: [n][2 l + 1][3] */
    int32_t *quats;
    int32_t *exponents; /* [5 + sh_degree]: opacities, scales, quats, means, sh0, bands */
} csplat_integers;

/* Quantised values in narrow arrays: an integer is offset[column] + element, a value float32(integer * step).
 * Opacities and quats have no step, see csplat_info. Colours are R, G, B; column channel * (2l + 1) + m of an SH
 * band contains coefficient m. The pointers are valid until anything but a codebook is read. */
typedef struct csplat_columns {
    const void *data;       /* u8, u16 or u32: all elements of column 0, then of column 1, ... */
    unsigned width;         /* bytes per element: 1, 2 or 4 */
    unsigned columns;
    uint32_t count;         /* rows */
    int64_t offset[3 * (2 * CSPLAT_SH_DEGREE_MAX + 1)];
    double step;
} csplat_columns;

/* One attribute. If `index` is not NULL, the values are in a codebook, except those of the splats in `rows`, whose index is
 * the size of the codebook: `columns` has a row for each of them. If only `rows` is not NULL, `columns` has the splats in
 * `rows`, and all others are 0. */
typedef struct csplat_packed {
    csplat_columns columns;
    const uint32_t *rows;  /* [columns.count], or NULL for all splats */
    const void *index;     /* [n] u8, u16 or u32, or NULL */
    unsigned index_width;
    uint16_t codebook;     /* id of the codebook */
} csplat_packed;

/* Layer 0 of a tile. */
typedef struct csplat_packed_geometry {
    csplat_packed opacities, scales, quats, means, sh0; /* quats: x, y, z; w follows (specification, 7.5) */
} csplat_packed_geometry;

/* Bounds of an error; negative if not declared. */
typedef struct csplat_declared_error {
    double max, rms;
} csplat_declared_error;

/* Error bounds declared in the file. */
typedef struct csplat_declared_errors {
    uint64_t source_count, pruned_count;
    uint8_t source_sh_degree, refitted;
    csplat_declared_error means, covariance, opacities, sh[CSPLAT_SH_DEGREE_MAX + 1];
} csplat_declared_errors;

typedef enum csplat_text { CSPLAT_METADATA, CSPLAT_CAMERAS, CSPLAT_ENCODER_OPTIONS } csplat_text;

/* Read and check header and index. *out is NULL on failure; `options` and `error` may be NULL. csplat_open_memory does not
 * copy `data`, which must remain valid until csplat_close. */
csplat_code csplat_open_memory(csplat **out, const void *data, size_t size, const csplat_options *options,
                               csplat_error *error);
csplat_code csplat_open(csplat **out, const csplat_source *source, const csplat_options *options, csplat_error *error);
void csplat_close(csplat *file);

const csplat_info *csplat_get_info(const csplat *file);
/* Here and below, a tile may be of any level. */
csplat_code csplat_get_tile(csplat *file, uint32_t tile, csplat_tile *out);
const csplat_error *csplat_last_error(const csplat *file);

/* Decode all splats of level 0 into new arrays, which csplat_free_scene releases. If sh_degree is below the file's, higher bands
 * are neither read nor checked; otherwise the whole file is, as the specification requires of exact decoders. Of tiles above
 * level 0 it checks CRC and chunk header, and leaves the payloads unread. */
csplat_code csplat_decode(csplat *file, unsigned sh_degree, csplat_scene **out);
void csplat_free_scene(csplat *file, csplat_scene *scene);

/* Read a tile with its SH bands up to a degree; bands above the file's degree are 0. */
csplat_code csplat_read_tile(csplat *file, uint32_t tile, unsigned sh_degree, const csplat_floats *out);
/* Read an SH band, [n][2 * band + 1][3]; 0 if the tile leaves it out. */
csplat_code csplat_read_band(csplat *file, uint32_t tile, unsigned band, float *out);
/* Read extra columns: out[i] receives the values of column i; columns whose out[i] is NULL are not read. If out is NULL, all are
 * read and checked. Tiles above level 0 have none: E_INPUT. */
csplat_code csplat_read_extras(csplat *file, uint32_t tile, void *const *out);
csplat_code csplat_read_integers(csplat *file, uint32_t tile, const csplat_integers *out);

csplat_code csplat_read_packed(csplat *file, uint32_t tile, csplat_packed_geometry *out);
/* columns.count and index are 0 if the tile leaves the band out. */
csplat_code csplat_read_packed_band(csplat *file, uint32_t tile, unsigned band, csplat_packed *out);
/* Read a band of a codebook: its entries, followed by one row of zeros for splats without an entry. */
csplat_code csplat_read_packed_codebook(csplat *file, uint16_t id, unsigned band, csplat_columns *out);

/* Read the nodes of the levels of detail, which are valid until csplat_close. A file without levels has one node of all tiles, or
 * none if it has no tiles. */
csplat_code csplat_read_nodes(csplat *file, const csplat_node **nodes, uint32_t *count);
/* Select the tiles of a cut, in ascending order. `tiles` has room for tile_count + coarse_tile_count numbers. E_LIMIT if even the
 * coarsest cut has more splats than `splats`. */
csplat_code csplat_select(csplat *file, const csplat_cut *cut, uint32_t *tiles, uint32_t *count);

/* Read a JSON text, checked by section 5.4. It is valid until the next text is read. NULL if the file has none. */
csplat_code csplat_read_text(csplat *file, csplat_text which, const char **text, size_t *size);
/* *found is 0 if the file declares none. */
csplat_code csplat_read_declared_errors(csplat *file, csplat_declared_errors *out, int *found);

/* Check everything outside the tiles of level 0: CRCs of skipped chunks and layers and of coarser tiles, nodes, codebooks, texts,
 * declared errors. */
csplat_code csplat_check(csplat *file);

/* "E_CRC" */
const char *csplat_code_name(csplat_code code);

/* "1.0.0" */
const char *csplat_version(void);

/* An inflate for csplat_options, in inflate.c. */
int csplat_inflate(void *user, const uint8_t *coded, size_t coded_size, uint8_t *out, size_t size);

#ifdef __cplusplus
}
#endif
#endif
