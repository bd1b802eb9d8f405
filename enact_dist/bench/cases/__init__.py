"""The benches: each measures its cases and adds their rows to a run."""
