"""The commands, one module each: they parse options, call a library function, and print."""
