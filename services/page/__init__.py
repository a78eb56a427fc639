"""The web page of a run: shows how its robots learn, and lets a person stop and steer them."""
