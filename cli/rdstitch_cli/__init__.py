"""The command line of rdstitch: options in, one library call, a line out."""
