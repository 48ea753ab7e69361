"""Lost objects, and those that look like them."""
