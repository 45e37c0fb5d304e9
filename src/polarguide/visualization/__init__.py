"""Arrays to 8-bit pictures: false colors, contact sheets, layers, pictures inside a page."""
