"""`enact actor`: run actors, and send them messages."""
