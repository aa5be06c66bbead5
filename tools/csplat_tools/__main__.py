"""`python -m csplat_tools` is `csplat`."""

from csplat_tools.cli import main

if __name__ == "__main__":
    main()
