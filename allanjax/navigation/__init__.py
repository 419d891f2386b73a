"""What a noise model does to a navigator: growth of its errors, alignment, and the sample rate."""
