"""Search for what a sensor's spectrum consists of: a response, resonances and noise terms, fitted jointly."""
