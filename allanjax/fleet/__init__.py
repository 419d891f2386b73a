"""Many recordings and long ones: streams, fleets of units, and units that are unlike the others."""
