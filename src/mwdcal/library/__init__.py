"""One function for each task of `import mwdcal`: `face` has them all, a command loads its own alone."""
