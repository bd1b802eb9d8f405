"""Compare world contexts: differences of two of them, and differences that are followed."""
