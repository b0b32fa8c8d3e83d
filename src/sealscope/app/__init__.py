"""The workbench: a page in the browser, on this computer, to open logs, see them, commission a machine and judge it."""

import sealscope.web  # noqa: F401 (says which extra is missing before the modules that need it are imported)
