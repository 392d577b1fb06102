//! `MapService`: list, get, put, delete, add images.

use futures_util::{StreamExt, TryStreamExt, stream};
use tokio::sync::OwnedSemaphorePermit;
use tonic::{Request, Response, Status, Streaming};

use super::proto::add_image_result::Outcome;
use super::proto::map_service_server::MapService;
use super::proto::{
    AddImageResult, AddImagesRequest, AddImagesResponse, DeleteMapRequest, DeleteMapResponse,
    GetMapRequest, GetMapResponse, ListMapsRequest, ListMapsResponse, PutMapRequest,
    PutMapResponse, Stored,
};
use super::{Api, CallContext, convert, status};
use whereabouts_api::{ImageMeta, MapChange};
use whereabouts_core::MapName;
use whereabouts_service::{BulkImage, BulkResult, ServiceError, StoredImage};
use whereabouts_store::Added;

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
        let images = images.map_ok(|next| image(&map, next, context.budget.take()));
        let until =
            context.service.cancelled_by(&self.readiness, context.caller.clone(), context.deadline);
        let results = context.service.images.add_many(&map, &context.caller, images, until).await?;
        Ok(Response::new(AddImagesResponse { results: results.into_iter().map(result).collect() }))
    }
}

impl CallContext {
    async fn put_map(&self, request: PutMapRequest) -> Result<PutMapResponse, ServiceError> {
        let PutMapRequest { map, scene, descriptor, frame, model, description } = request;
        let change = MapChange {
            scene: convert::scene(scene)?,
            descriptor: convert::descriptor(descriptor)?,
            frame: convert::frame(frame)?,
            model,
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
    let AddImagesRequest { map: named, image, id, pose, captured_at, tags } = next;
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
    };
    Ok(BulkImage { bytes: image, meta, memory })
}

fn result(result: BulkResult) -> AddImageResult {
    let (image, present, warnings) = match result {
        Ok(StoredImage { added: Added::Created(image), warnings }) => (image, false, warnings),
        Ok(StoredImage { added: Added::Present(image), warnings }) => (image, true, warnings),
        Err((id, error)) => {
            let outcome = Some(Outcome::Problem(convert::problem(error)));
            let id = id.map(Into::into).unwrap_or_default();
            return AddImageResult { id, outcome };
        }
    };
    let stored = Stored {
        present,
        digest: image.digest.to_string(),
        width: image.width,
        height: image.height,
        warnings,
    };
    AddImageResult { id: image.id.to_string(), outcome: Some(Outcome::Stored(stored)) }
}
