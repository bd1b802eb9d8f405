"""The protocol: messages, answers, records and data, and checks that need no state."""
