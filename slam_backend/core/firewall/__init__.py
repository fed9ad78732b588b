"""What the firewall judges by: `rules` is the table; one file for each kind of thing that is judged."""
