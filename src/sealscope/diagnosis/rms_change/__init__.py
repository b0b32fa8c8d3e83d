"""The thesis's method: detect a leak by a change of the RMS of the pressures' db8 wavelet details."""
