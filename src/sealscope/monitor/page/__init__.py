"""The monitor's page: the fleet, one actuator's life, and what a person says of its alarm."""

from sealscope.errors import MissingExtra

try:
    import prometheus_client  # noqa: F401 (asked for before what needs them)
    import starlette  # noqa: F401
    import uvicorn  # noqa: F401
except ImportError:
    raise MissingExtra("the page needs starlette and uvicorn: pip install 'sealscope[serve]'") from None
