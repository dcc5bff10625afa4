"""The command line: composition of settings, help, completion, and errors in one line."""
