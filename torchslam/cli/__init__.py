"""The command line: a module for each large command, `add_arguments(parser)` and `execute(options) -> exit status`."""
