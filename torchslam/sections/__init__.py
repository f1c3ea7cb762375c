"""The sections of the configuration, by what they are about; `torchslam.config` puts them together."""
