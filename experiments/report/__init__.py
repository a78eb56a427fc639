"""What runs gave: tables, figures, findings, pages."""
