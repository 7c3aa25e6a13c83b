"""The registry's database: connections, tables and their migrations, and the chain of its history."""
