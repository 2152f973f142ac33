"""Drivers of SUMO's car-following models fitted to recorded tracks, one by one and as a population."""
