"""The seven methods, a file for each word of the command line, and what several of them share."""
