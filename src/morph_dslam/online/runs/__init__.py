"""What a run leaves: its folder, tables, plots and flags."""
