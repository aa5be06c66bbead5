/* SPDX-License-Identifier: Apache-2.0 */
/* An encoder for .csplat, a compressed format for 3D Gaussian splats (spec/format.md).
 *
 *     csplat_splats splats = {count, 3, means, quats, scales, opacities, sh0, shN};
 *     csplat_error error;
 *     uint8_t *file;
 *     size_t size;
 *     if (csplat_encode(&splats, NULL, &file, &size, &error)) return puts(error.message);
 *     fwrite(file, 1, size, stream);
 *     free(file);
 *
 * It chooses what the preset "fast" of the encoder in Python chooses: the same steps, tiles, codebook and order of splats, and
 * therefore the same integers. There is no global state; the same input gives the same bytes on every machine. */
#ifndef CSPLAT_ENCODE_H
#define CSPLAT_ENCODE_H

#include "csplat.h"

#ifdef __cplusplus
extern "C" {
#endif

/* A scene. All numbers are finite. */
typedef struct csplat_splats {
    uint32_t count;          /* N */
    unsigned sh_degree;      /* 0 to CSPLAT_SH_DEGREE_MAX; K = (sh_degree + 1)^2 - 1 */
    const float *means;      /* [N][3], scene units, relative to the origin */
    const float *quats;      /* [N][4], w x y z, of unit length within 0.001 */
    const float *scales;     /* [N][3], natural logarithms of the standard deviations */
    const float *opacities;  /* [N], alpha, 0 to 1 */
    const float *sh0;        /* [N][3], SH coefficient of band 0 */
    const float *shN;        /* [N][K][3], bands 1 to sh_degree; may be NULL if that is 0 */
    const double *positions; /* [N][3], of which `means` are the differences from the origin, rounded; NULL if means are exact */
    double origin[3];        /* of the means */
    double unit_metres;      /* 0 if unknown */
    char axes[4];            /* directions of +x, +y, +z: letters of R L U D F B; "" if unknown */
    uint8_t antialiased, flat; /* how the scene was trained: filter of Mip-Splatting, 2DGS */
    uint8_t colour_space;    /* 0: sRGB, 1: linear light (specification, 12) */
    const char *metadata;    /* a JSON object, the chunk META (specification, 5.4), or NULL; its syntax is not checked */
    size_t metadata_size;
} csplat_splats;

/* Every field may be 0, the default. */
typedef struct csplat_encode_options {
    uint32_t *source_index; /* [N], receives the row of the splats that each splat of the file represents */
    /* Called with the finished fraction of the work; encoding stops with E_INPUT if it returns 0. */
    int (*progress)(void *user, double done);
    /* Replace malloc and free. Set both or neither. */
    void *(*allocate)(void *user, size_t size);
    void (*release)(void *user, void *memory);
    /* Replaces csplat_deflate: compress to raw DEFLATE (RFC 1951) of at most `room` bytes, and return their number, or 0 if
     * there is not enough room. Section 6.2 of the specification has further requirements, which zlib and libdeflate meet. */
    size_t (*deflate)(void *user, const uint8_t *data, size_t size, uint8_t *out, size_t room);
    void *user; /* passed to the four functions above */
} csplat_encode_options;

/* Encode a scene to a new array, which the caller releases with `release` of the options, or free. E_INPUT: a number is not finite
 * or out of range, or fits no lattice. E_LIMIT: out of memory. `options` and `error` may be NULL. */
csplat_code csplat_encode(const csplat_splats *splats, const csplat_encode_options *options, uint8_t **file, size_t *size,
                          csplat_error *error);

/* A scene from a PLY. */
typedef struct csplat_ply {
    csplat_splats splats; /* its arrays are in `memory` */
    uint64_t row_count;   /* rows of the file; those with NaN or infinity are left out (specification, SRC-1) */
    void *memory;         /* release it with `release` of the options, or free */
} csplat_ply;

/* Read a PLY as trainers write it, binary of either byte order or text: columns x y z, rot_0..3, scale_0..2, opacity, f_dc_0..2 and
 * f_rest_0..., floats or doubles in any order (specification, E.1). Other columns and elements are left out. Comments of csplat
 * specify origin, axes, unit and how to render. Numbers of a text are the same in every locale, and rows are those that csplat.read
 * accepts. E_INPUT: the file is no such PLY, or is damaged. */
csplat_code csplat_read_ply(const void *data, size_t size, const csplat_encode_options *options, csplat_ply *out,
                            csplat_error *error);

/* Return e^x, the same bits on every machine; the alpha of a logit is 1 / (1 + csplat_exp(-logit)). */
double csplat_exp(double x);

#define CSPLAT_DEFLATE_WORK 600000 /* bytes of working memory, aligned as memory of malloc */
/* Compress at most 2^32 - 2 bytes, at least 1, quickly; see `deflate` above. */
size_t csplat_deflate(const uint8_t *data, size_t size, uint8_t *out, size_t room, void *work);

#ifdef __cplusplus
}
#endif

#endif
