"""The measured programs, one for each library, with the same command line."""
