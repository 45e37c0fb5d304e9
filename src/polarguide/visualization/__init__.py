"""Arrays to pictures for people: false colors, contact sheets, layers, pictures inside a page."""
