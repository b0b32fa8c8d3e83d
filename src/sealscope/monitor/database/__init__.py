"""What a monitor keeps in its database."""

from sealscope.errors import MissingExtra

try:
    import sqlalchemy  # noqa: F401 (asked for before what needs it)
except ImportError:
    raise MissingExtra("the monitor's database needs SQLAlchemy: pip install 'sealscope[serve]'") from None
