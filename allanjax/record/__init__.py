"""The recording: samples with their axes, units and auxiliary channels, and the files they come from."""
