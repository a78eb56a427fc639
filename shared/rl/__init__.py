"""The algorithm, pure: values in, values out, numerical libraries only.

Read in this order: reward, episode, policy, network, descriptor, similarity, memory, retention,
learning, turn. Each function cites its equation (Eq ..), requirement (A..) or reading (E..).
"""
