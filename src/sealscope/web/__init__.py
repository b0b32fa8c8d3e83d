"""What the pages that a server shows have in common: access control, headers, the server, style and charts."""

from sealscope.errors import MissingExtra

try:
    import starlette  # noqa: F401 (checked before the modules that need them)
    import uvicorn  # noqa: F401
except ImportError:
    raise MissingExtra("a page needs starlette and uvicorn: pip install 'sealscope[serve]'") from None
