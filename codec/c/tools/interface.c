/* Tests beyond the conformance suite: failing callbacks, budgets, invalid arguments, a lower degree.
 *
 *     interface FILE...        status 0, or the line number of a failed check on standard error */
#include "csplat.h"

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

/* Open through callbacks, read everything, return the code. `d` is closed afterwards. */
static csplat_code read_all(caller *c, size_t size, const csplat_options *options)
{
    csplat_source source = {read_bytes, c, size};
    csplat_scene *scene;
    csplat_packed packed;
    csplat_packed_geometry geometry;
    csplat_columns columns;
    csplat_stated_errors errors;
    csplat *d;
    const char *text;
    size_t length;
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
        code = csplat_read_stated_errors(d, &errors, &found);
    for (uint32_t i = 0; i < csplat_get_info(d)->tile_count && !code; i++) {
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
    csplat_stated_errors errors;
    const char *text;
    size_t length;
    csplat *d;
    int found;
    HOLDS(!csplat_open_memory(&d, data, size, NULL, NULL) && !csplat_decode(d, CSPLAT_SH_DEGREE_MAX, &scene));
    options.splats_max = scene->splat_count - 1;
    csplat_free_scene(d, scene);
    HOLDS(!csplat_check(d) && !csplat_read_text(d, CSPLAT_METADATA, &text, &length) && text && text[length] == '\0');
    HOLDS(!csplat_read_stated_errors(d, &errors, &found));
    csplat_close(d);
    HOLDS(!csplat_open_memory(&d, data, size, &options, NULL) && csplat_decode(d, CSPLAT_SH_DEGREE_MAX, &scene) == CSPLAT_E_LIMIT && !scene);
    csplat_close(d);
    options.splats_max = 0;
    options.bytes_max = 50;
    options.json_bytes_max = length - 1;
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
    HOLDS(csplat_get_tile(d, csplat_get_info(d)->tile_count, &tile) == CSPLAT_E_INPUT);
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
    }
    return 0;
}
