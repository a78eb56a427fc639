"""The web page in a real browser: `python -m tests.page.trial`."""
