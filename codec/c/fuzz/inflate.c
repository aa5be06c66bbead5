/* csplat_inflate beside zlib, by libFuzzer: both take the same streams and give the same bytes. `make fuzz-c` */
#include "../inflate.c"

#include <stdlib.h>
#include <zlib.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/* The first byte says how many bytes less, or more, than zlib gives are asked for: none, mostly. */
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    enum { ROOM = 1 << 16 };
    static uint8_t theirs[ROOM];
    z_stream z = {0};
    uint8_t *coded, *ours;
    size_t wanted;
    int ended, right;
    if (size < 2 || inflateInit2(&z, -MAX_WBITS) != Z_OK)
        return 0;
    coded = malloc(size - 1); /* of exactly that size: the sanitizer guards what follows */
    memcpy(coded, data + 1, size - 1);
    z.next_in = coded;
    z.avail_in = (uInt)size - 1;
    z.next_out = theirs;
    z.avail_out = ROOM;
    ended = inflate(&z, Z_FINISH) == Z_STREAM_END && z.avail_in == 0;
    wanted = z.total_out + (data[0] == 1) - (data[0] == 2 && z.total_out);
    inflateEnd(&z);
    ours = malloc(wanted ? wanted : 1);
    right = csplat_inflate(NULL, coded, size - 1, ours, wanted);
    if (right != (ended && wanted == z.total_out) || (right && memcmp(ours, theirs, wanted) != 0))
        abort();
    free(ours);
    free(coded);
    return 0;
}
