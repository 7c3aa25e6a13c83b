"""What is printed of certificates, keys and the registry."""
