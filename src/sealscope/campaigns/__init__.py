"""Campaigns: many simulated or real recordings, planned in a file and judged by several detectors; resumable."""
