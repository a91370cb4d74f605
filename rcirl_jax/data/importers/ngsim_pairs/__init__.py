"""Car-following pairs cut from NGSIM: `reader`."""
