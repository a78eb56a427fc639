"""The simulated robot: worlds as data, their scene in PyBullet, camera and bumper."""
