"""Results of a run: files, reports, plots, the viewer and exports."""
