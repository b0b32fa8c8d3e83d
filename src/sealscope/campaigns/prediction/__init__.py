"""Prediction: the smallest leak that each detector finds on a rig, before anyone measures."""
