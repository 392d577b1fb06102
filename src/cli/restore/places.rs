//! The order in which the images of a backup were recorded: they are in it by id, are sent side by side, and arrive in
//! any order, while tracks follow the paths of a map in the order of recording.

use std::collections::HashMap;

use whereabouts_core::{ExportedImage, ImageId, Map, MapName, Recording};

/// The places of the images of each map.
#[derive(Default)]
pub(super) struct Places {
    /// The map whose images come next.
    map: Option<Map>,
    /// The images of that map, each with its position in the order of addition and its place in a recording.
    images: Vec<(ImageId, usize, Option<Recording>)>,
    places: HashMap<MapName, HashMap<ImageId, Recording>>,
}

impl Places {
    /// Begins with the images of a map.
    pub fn begin(&mut self, map: Map) {
        self.number();
        self.map = Some(map);
    }

    /// Adds the next image of the map.
    pub fn add(&mut self, exported: &ExportedImage) {
        let position = exported.position.and_then(|position| usize::try_from(position).ok());
        // Older backups have no positions; their order is the best that is known.
        let position = position.unwrap_or(self.images.len());
        self.images.push((exported.image.id.clone(), position, exported.recording));
    }

    /// Ends with the last map.
    pub fn numbered(mut self) -> Self {
        self.number();
        self
    }

    /// Makes the map one recording, so that what is added to the restored map later comes after it.
    fn number(&mut self) {
        let Some(map) = self.map.take() else { return };
        let mut images = std::mem::take(&mut self.images);
        Recording::sort(&mut images, |(_, position, recording)| (*position, *recording));
        let images = (0..u32::MAX).zip(images);
        let places = images.map(|(number, (id, ..))| (id, Recording { id: map.uid, number }));
        self.places.insert(map.name, places.collect());
    }

    /// The place of an image of a map.
    pub fn of(&self, map: &Map, image: &ExportedImage) -> Option<Recording> {
        self.places.get(&map.name)?.get(&image.image.id).copied()
    }
}
