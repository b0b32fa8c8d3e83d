"""Wavelet details and RMS over sliding windows, of complete recordings and of live signals.

`details.details` transforms a complete signal, and `streams.DetailStream` a live signal block by block.
`windows.windowed_rms` and `windows.RmsStream` compute the RMS of the details in the same two ways.
"""
