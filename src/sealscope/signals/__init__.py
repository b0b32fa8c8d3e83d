"""Wavelet details (whole recordings and live blocks) and windowed RMS.

`details.details` transforms a recording's channel, `streaming.DetailStream` the same channel block by block;
`windows.windowed_rms` and `windows.RmsStream` are the same pair for the RMS of the details.
"""
