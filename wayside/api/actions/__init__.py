"""What a rule does about its episodes: each kind of action, as a rule says it. They run in detector/actions."""
