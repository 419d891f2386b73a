"""What every room uses: errors, equality by value, text for people, linear algebra, compiled programs."""
