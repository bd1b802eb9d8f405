"""Palletizing with error monitoring (ENACT 4.2, Figure 7): learn products, then watch a tray."""
