# SPDX-License-Identifier: Apache-2.0
"""serve.py FILE THREADS: print "ready", then decode once for each input line; print seconds and bytes of arrays."""

import sys
import time
from pathlib import Path

from csplat.context import Context
from csplat.decoder import decode

data, context = Path(sys.argv[1]).read_bytes(), Context(threads=int(sys.argv[2]))
print("ready", flush=True)
for _ in sys.stdin:
    began = time.perf_counter()
    scene = decode(data, context=context)
    seconds = time.perf_counter() - began
    arrays = scene.means, scene.quats, scene.scales, scene.opacities, scene.sh0, scene.shN
    print(seconds, sum(array.nbytes for array in arrays), flush=True)
    del scene, arrays
