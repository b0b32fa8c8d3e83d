"""Wavelet details and windowed RMS, of whole recordings and of live blocks.

`details.details` transforms a recording's channel, `streams.DetailStream` the same channel block by block;
`windows.windowed_rms` and `windows.RmsStream` are the same pair for the RMS of the details.
"""
