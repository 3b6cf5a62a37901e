"""The only place that knows topics, their QoS and the fields of messages."""
