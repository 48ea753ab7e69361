"""What results say about themselves: duplicates, wrong dimensions, reference errors."""
