"""The report of a comparison: one HTML file, the plots as files, and the animation."""
