//! `MapService`: list, get, put and delete maps; add and change images.

use futures_util::{StreamExt, TryStreamExt, stream};
use tokio::sync::OwnedSemaphorePermit;
use tonic::{Request, Response, Status, Streaming};

use super::proto::add_image_result::Outcome;
use super::proto::map_service_server::MapService;
use super::proto::{
    AddImageResult, AddImagesRequest, AddImagesResponse, DeleteMapRequest, DeleteMapResponse,
    FindImagesRequest, FindImagesResponse, GetMapRequest, GetMapResponse, ListMapsRequest,
    ListMapsResponse, PutMapRequest, PutMapResponse, Stored, UpdateImageRequest,
    UpdateImageResponse,
};
use super::{Api, CallContext, convert, status};
use whereabouts_api::{ImageAnswer, ImageMeta, ImagePatch, MapChange};
use whereabouts_core::{ImageField, MapName};
use whereabouts_service::{BulkImage, BulkItem, BulkResult, ServiceError};

#[tonic::async_trait]
impl MapService for Api {
    async fn list_maps(
        &self,
        request: Request<ListMapsRequest>,
    ) -> Result<Response<ListMapsResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let maps = context.service.maps.list().await.map_err(status::of)?.into_iter();
        let maps = maps.filter(|map| context.caller.may_use(&map.name));
        Ok(Response::new(ListMapsResponse { maps: maps.map(Into::into).collect() }))
    }

    async fn get_map(
        &self,
        request: Request<GetMapRequest>,
    ) -> Result<Response<GetMapResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let name = context.map(&request.get_ref().map).map_err(status::of)?;
        let map = context.service.maps.get(&name).await.map_err(status::of)?;
        Ok(Response::new(GetMapResponse { map: Some(map.into()) }))
    }

    async fn put_map(
        &self,
        request: Request<PutMapRequest>,
    ) -> Result<Response<PutMapResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let answer = context.put_map(request.into_inner()).await.map_err(status::of)?;
        Ok(Response::new(answer))
    }

    async fn delete_map(
        &self,
        request: Request<DeleteMapRequest>,
    ) -> Result<Response<DeleteMapResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let name = context.map(&request.get_ref().map).map_err(status::of)?;
        context.service.maps.delete(&name).await.map_err(status::of)?;
        Ok(Response::new(DeleteMapResponse {}))
    }

    async fn add_images(
        &self,
        request: Request<Streaming<AddImagesRequest>>,
    ) -> Result<Response<AddImagesResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let mut incoming = request.into_inner();
        let Some(first) = incoming.message().await? else {
            return Ok(Response::new(AddImagesResponse { results: Vec::new() }));
        };
        let map = context.map(&first.map).map_err(status::of)?;
        context.service.maps.get(&map).await.map_err(status::of)?;
        let images = stream::iter([Ok(first)]).chain(incoming);
        let images = images.map_ok(|next| match image(&map, next, context.budget.take()) {
            Ok(image) => BulkItem::Image(image),
            Err(error) => BulkItem::Failed(error),
        });
        let images = images.enumerate().map(|(number, image)| image.map(|image| (number, image)));
        let until =
            context.service.cancelled_by(&self.readiness, context.caller.clone(), context.deadline);
        let results = context.service.images.add_many(&map, &context.caller, images, until).await?;
        Ok(Response::new(AddImagesResponse { results: results.into_iter().map(result).collect() }))
    }

    async fn update_image(
        &self,
        request: Request<UpdateImageRequest>,
    ) -> Result<Response<UpdateImageResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let answer = context.update_image(request.into_inner()).await.map_err(status::of)?;
        Ok(Response::new(answer))
    }

    async fn find_images(
        &self,
        request: Request<FindImagesRequest>,
    ) -> Result<Response<FindImagesResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let answer = context.find_images(request.into_inner()).await.map_err(status::of)?;
        Ok(Response::new(answer))
    }
}

impl CallContext {
    async fn find_images(
        &self,
        request: FindImagesRequest,
    ) -> Result<FindImagesResponse, ServiceError> {
        let FindImagesRequest { map, text, limit, cursor } = request;
        let limit = (limit > 0).then_some(limit as usize);
        let cursor = (!cursor.is_empty()).then_some(cursor.as_str());
        let page = self.service.images.find(&self.map(&map)?, &text, cursor, limit).await?;
        Ok(page.into())
    }

    async fn update_image(
        &self,
        request: UpdateImageRequest,
    ) -> Result<UpdateImageResponse, ServiceError> {
        let (map, id) = (self.map(&request.map)?, request.id.parse()?);
        let answer = self.service.images.update(&map, &id, &patch(request)?).await?;
        let changed = names(&answer.changed);
        Ok(UpdateImageResponse { image: Some(answer.image.into()), changed })
    }

    async fn put_map(&self, request: PutMapRequest) -> Result<PutMapResponse, ServiceError> {
        let PutMapRequest { map, scene, descriptor, frame, model, description, refiner } = request;
        let change = MapChange {
            scene: convert::scene(scene)?,
            descriptor: descriptor.map(|kind| kind.parse()).transpose()?,
            frame: convert::frame(frame)?,
            model,
            refiner: convert::map_refiner(refiner)?,
            description,
        };
        let (map, created) = self.service.maps.put(self.map(&map)?, change).await?;
        Ok(PutMapResponse { map: Some(map.into()), created })
    }
}

/// Converts the next image of a stream.
fn image(
    map: &MapName,
    next: AddImagesRequest,
    memory: Option<OwnedSemaphorePermit>,
) -> Result<BulkImage, ServiceError> {
    let AddImagesRequest { map: named, image, id, pose, captured_at, tags, recording } = next;
    if !named.is_empty() && named != map.as_str() {
        return Err(ServiceError::malformed(format!(
            "the images of one call go into one map, {map}; call again for another"
        )));
    }
    let meta = ImageMeta {
        id,
        pose: pose.map(convert::pose),
        captured_at: captured_at.map(convert::moment).transpose()?,
        tags,
        recording: recording.map(convert::recording).transpose()?,
    };
    Ok(BulkImage { bytes: image, meta, memory })
}

fn result(result: BulkResult) -> AddImageResult {
    let problem = |id: String, error: ServiceError| AddImageResult {
        id,
        outcome: Some(Outcome::Problem(convert::problem(error))),
    };
    match result {
        BulkResult::Saved(answer, new) => {
            let ImageAnswer { image, changed, warnings } = *answer;
            let stored = Stored {
                present: !new,
                digest: image.digest.to_string(),
                width: image.width,
                height: image.height,
                changed: names(&changed),
                warnings,
            };
            AddImageResult { id: image.id.to_string(), outcome: Some(Outcome::Stored(stored)) }
        }
        BulkResult::Failed(id, error) => problem(id.map(Into::into).unwrap_or_default(), error),
        BulkResult::Skipped(name, why) => problem(name, ServiceError::malformed(why)),
    }
}

fn names(fields: &[ImageField]) -> Vec<String> {
    fields.iter().map(|field| field.as_str().to_owned()).collect()
}

/// Converts a request whose mask names the fields to change; without one, those that are set are changed.
fn patch(request: UpdateImageRequest) -> Result<ImagePatch, ServiceError> {
    let UpdateImageRequest { pose, captured_at, tags, update_mask, .. } = request;
    let pose = pose.map(|pose| convert::pose(pose).into());
    let captured_at = captured_at.map(convert::moment).transpose()?;
    let tags = (!tags.is_empty()).then_some(tags);
    let Some(mask) = update_mask.filter(|mask| !mask.paths.is_empty()) else {
        return Ok(ImagePatch {
            pose: pose.map(Some),
            captured_at: captured_at.map(Some),
            tags: tags.map(Some),
        });
    };
    let mut patch = ImagePatch::default();
    for path in &mask.paths {
        match path.as_str() {
            "pose" => patch.pose = Some(pose),
            "captured_at" => patch.captured_at = Some(captured_at),
            "tags" => patch.tags = Some(tags.clone()),
            other => {
                return Err(ServiceError::malformed(format!(
                    "update_mask names {other:?}; it may name pose, captured_at and tags"
                )));
            }
        }
    }
    Ok(patch)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(paths: &[&str]) -> UpdateImageRequest {
        let paths = paths.iter().map(|path| (*path).to_owned()).collect();
        UpdateImageRequest {
            tags: vec!["a".into()],
            update_mask: Some(prost_types::FieldMask { paths }),
            ..UpdateImageRequest::default()
        }
    }

    #[test]
    fn a_mask_removes_the_fields_that_are_not_set_and_keeps_those_it_does_not_name() {
        let tags = Some(Some(vec!["a".to_owned()]));
        let set = ImagePatch { tags: tags.clone(), ..ImagePatch::default() };
        assert_eq!(patch(request(&[])).unwrap(), set);
        let removed = ImagePatch { pose: Some(None), ..ImagePatch::default() };
        assert_eq!(patch(request(&["pose"])).unwrap(), removed);
        let both = ImagePatch { captured_at: Some(None), tags, pose: None };
        assert_eq!(patch(request(&["tags", "captured_at"])).unwrap(), both);
        let refused = patch(request(&["pose.lat"])).unwrap_err();
        assert!(refused.detail.contains("pose.lat"), "{refused}");
    }
}
