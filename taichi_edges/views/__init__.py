"""What every later room knows about the input: cameras, views, edgels, pictures."""
