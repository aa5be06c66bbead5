"""Files that keep to a target: a size, a PSNR, largest errors. `targets` and `bounds` want no renderer."""
