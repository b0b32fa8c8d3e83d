"""The database of a monitor."""

from sealscope.errors import MissingExtra

try:
    import sqlalchemy  # noqa: F401 (checked before the modules that need it)
except ImportError:
    raise MissingExtra("the monitor's database needs SQLAlchemy: pip install 'sealscope[serve]'") from None
