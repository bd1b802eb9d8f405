"""The demo of the workcell: all processes, conducted, recorded and reported."""
