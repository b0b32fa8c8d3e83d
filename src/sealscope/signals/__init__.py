"""Wavelet details of a signal (`details.details`), and RMS over sliding windows (`windows.windowed_rms`)."""
