"""Networks that run without the script that made them."""
