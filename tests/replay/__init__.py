"""Driving among recorded vehicles."""
