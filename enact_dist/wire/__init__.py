"""Messages and data as bytes, pure: nothing here waits, reads a clock or opens a socket.

A frame is a msgpack header and raw bodies behind it (`frames`); a datum is a msgpack tree and raw
arrays behind it (`payload`); both modules draw their format, so that another language can read it.
No pickle, ever.  Everything that arrives is bounded (`limits`) and checked; what this version does
not know is refused.
"""
