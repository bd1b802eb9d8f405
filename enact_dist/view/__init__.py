"""A cell in the browser: its world contexts as a tree and as a scene, now and in the past.

`enact_dist.cli.view` starts it.  ::

    source -> feed -> drawing.scene -> pages.canvas      what is drawn
           -> catalogue, timeline, markup -> pages.page  what is listed, when, and for whom

`drawing`, `catalogue`, `timeline` and `markup` decide and are pure; `source`, `feed`, `activity`
and `recorded` read; `pages` alone knows viser.
"""
