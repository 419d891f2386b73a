"""Long recordings and many of them: streams, fleets of units, and outlying units."""
