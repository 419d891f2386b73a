"""Long recordings and many of them: streams, fleets of units, and units that are unlike the others."""
