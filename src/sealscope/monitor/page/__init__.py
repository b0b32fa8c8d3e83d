"""The monitor's page: the fleet, the history of one actuator, and the marks of its alarm."""

from sealscope.errors import MissingExtra

try:
    import prometheus_client  # noqa: F401 (checked before the modules that need them)
    import starlette  # noqa: F401
    import uvicorn  # noqa: F401
except ImportError:
    raise MissingExtra("the page needs starlette and uvicorn: pip install 'sealscope[serve]'") from None
