"""Touch data: sessions, locks, views and watches of data of one world context or several."""
