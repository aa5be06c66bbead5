"""Read and write scenes, arrays and images as files, which are written whole or not at all; load optional packages."""
