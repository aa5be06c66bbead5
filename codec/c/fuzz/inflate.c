/* SPDX-License-Identifier: Apache-2.0 */
/* Compare csplat_inflate with zlib by libFuzzer: both accept the same streams and return the same bytes. `make fuzz-c` */
#include "../inflate.c"

#include <stdlib.h>
#include <zlib.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/* The first byte is the difference between the requested size and zlib's output: 0 in most cases. */
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
    coded = malloc(size - 1); /* exactly this size, so that the sanitizer detects reads beyond it */
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
