"""`python -m sealscope`, the same as the command `sealscope`."""

from sealscope.cli import main

if __name__ == "__main__":
    main()
