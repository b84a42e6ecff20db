"""The paper's study (Digits, UIST 2012) repeated: twelve simulated people, six poses, three blocks; open loop."""
