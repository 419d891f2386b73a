"""Pages of HTML: one self-contained file that needs no network."""
