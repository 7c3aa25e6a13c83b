"""The face of `import mwdcal`: arrays converted and checked, and one function for each task."""
