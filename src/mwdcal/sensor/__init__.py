"""The sensor model, its parameters over temperature, and the tool profile that declares them."""
