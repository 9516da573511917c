"""The network itself and its weights, which both depth and matches are made with."""
