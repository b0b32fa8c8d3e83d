"""Campaigns: a plan of many simulated (or given) records, judged by detectors alike, kept on disk, resumable."""
