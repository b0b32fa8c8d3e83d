"""The workbench: a page in the browser, on this computer, to open logs, see them, commission a machine and judge it."""
