"""Who may connect to the router, and what each may say and hear there."""
