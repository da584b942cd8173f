"""Where to look next: poses in reach, whose frames would teach a scene most, in an order to travel them."""
