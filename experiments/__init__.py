"""What this project measures itself by: its tables, pictures, splits and baselines. Not in the wheel."""
