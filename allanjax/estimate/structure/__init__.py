"""Search for the structure of a sensor's spectrum: a response, resonances and noise terms, fitted jointly."""
