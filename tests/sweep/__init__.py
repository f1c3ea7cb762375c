"""A sweep of every public function of geometry, optim, features and evaluation over arguments that do not fit."""
