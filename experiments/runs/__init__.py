"""Running plans: stages, seeds side by side, snapshots, records."""
