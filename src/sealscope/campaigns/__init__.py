"""Campaigns: a plan of many simulated records or recordings, judged by several detectors, kept on disk, resumable."""
