"""What can be reproduced, and how items are made, kept and made anew."""
