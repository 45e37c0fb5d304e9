"""Published polarization datasets: layouts, cameras, and the sense of their angles."""
