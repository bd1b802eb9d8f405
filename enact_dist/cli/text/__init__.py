"""Text of the command line: tables, values, times and rates, read and written."""
