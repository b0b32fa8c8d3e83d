"""Run `python -m sealscope`, the same as the command `sealscope`."""

import sys

if __name__ == "__main__":
    if not sys.flags.safe_path:
        del sys.path[0]  # do not import from the working folder, whose files may be hostile
    from sealscope.cli import main

    main()
