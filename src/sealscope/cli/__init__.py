"""The command line."""

from sealscope.cli.app import main

__all__ = ["main"]
